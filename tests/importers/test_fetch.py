"""Public data sets from a local mirror: small raw files in the sources' layouts, and what is refused."""

import io
import json
import pickle
import zipfile
from collections import OrderedDict
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import numpy as np
import openpyxl
import pytest
import scipy.io
from importing_arm import run

from det2stoc_bayes.importers.base import SourceError
from det2stoc_bayes.importers.public import NAMES, ball_drops, download, fetch, fingerprints, servo_xl330
from det2stoc_bayes.importers.public.base import get_dataset
from det2stoc_bayes.importers.public.torch_files import read_tensor
from det2stoc_bayes.importers.write import sha256
from det2stoc_bayes.study import load_study


def torch_file(
    path: Path, values: np.ndarray, *, call: tuple[str, str] = ("torch._utils", "_rebuild_tensor_v2")
) -> None:
    """What torch.save writes for a float32 tensor: a pickle of protocol 2 in a zip archive, written out by hand."""

    def text(value: str) -> bytes:
        return b"X" + len(value).to_bytes(4, "little") + value.encode()

    def number(value: int) -> bytes:
        return b"J" + value.to_bytes(4, "little", signed=True)

    rows, columns = values.shape
    layout = b"\x80\x02c" + f"{call[0]}\n{call[1]}\n".encode() + b"(("
    layout += text("storage") + b"ctorch\nFloatStorage\n" + text("0") + text("cpu") + number(values.size) + b"tQ"
    layout += number(0) + number(rows) + number(columns) + b"\x86" + number(columns) + number(1) + b"\x86"
    layout += b"\x89ccollections\nOrderedDict\n)RtR."
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", layout)
        archive.writestr("archive/data/0", values.astype("<f4").tobytes())
        archive.writestr("archive/version", "3\n")


def mirror_of(name: str, folder: Path) -> Path:
    """A mirror with a place for every file of a data set."""
    data = get_dataset(name)
    for path in data.files:
        (folder / data.repository / data.commit / path).parent.mkdir(parents=True, exist_ok=True)
    return folder / data.repository / data.commit


def pendulum(root: Path) -> None:
    time = 0.001 * np.arange(41) + 15

    def cells(count: int) -> tuple[np.ndarray, np.ndarray]:
        y, t = np.empty((count, 1), object), np.empty((count, 1), object)
        for i in range(count):
            y[i, 0], t[i, 0] = np.stack([np.pi + np.cos(5 * time + i), -5 * np.sin(5 * time + i)]), time[:, None]
        return y, t

    (y_id, time_id), (y_vad, time_vad) = cells(4), cells(2)
    content = {"Y_id": y_id, "Time_id": time_id, "Y_vad": y_vad, "Time_vad": time_vad, "dt": 0.001}
    scipy.io.savemat(root / get_dataset("pendulum_multiarm").files[0], content)


def balls(root: Path) -> None:
    book = openpyxl.Workbook()
    book.remove(book.worksheets[0])
    time = np.arange(25) / 15
    for sheet in (*ball_drops.NAMES, "Volleyball"):
        page = book.create_sheet(sheet)
        page.append(["Drop #", "Time (s)", "Height (m)", "Velocity (m/s)"])
        for drop in (1, 2):
            for t in time:
                page.append([drop, t, 47 + drop - 4.9 * t**2, None])
    content = io.BytesIO()
    book.save(content)
    (root / ball_drops.SHEETS).write_bytes(content.getvalue())
    lines = [f"{name} 16 {100 * np.pi}" for name in ball_drops.NAMES.values()] + ["volleyball ?? ??"]
    (root / ball_drops.BALLS).write_text("\n".join(["ball weight(oz) circumference(cm)", *lines]))


def cube(root: Path) -> None:
    time = 0.0068 * np.arange(9)[:, None]
    turn = np.concatenate([np.cos(2 * time), 0 * time, 0 * time, np.sin(2 * time)], axis=1)
    turn[4:] *= -1  # the same orientations
    spin = np.concatenate([0 * time, 0 * time, 4 + 0 * time], axis=1)
    speed = np.concatenate([1 + 0 * time, 0 * time, 3 - 9.81 * time], axis=1)
    rows = np.concatenate([turn, time * speed + [0, 0, 1], spin, speed], axis=1)
    for path in get_dataset("cube_contactnets").files:
        torch_file(root / path, rows)


def servo(root: Path) -> None:
    runs = [
        (kp, name)
        for kp in (100, 200, 400, 800)
        for name in ("sin_sin", "lift_and_drop", "up_and_down", "sin_time_square")
    ]
    for path, (kp, name) in zip(servo_xl330.FILES, runs, strict=True):
        time = 0.0053 * np.arange(420) + 0.0035
        entries = [
            {"position": np.sin(3 * t) * kp / 100, "speed": 0.0,
             "load": int(t * 100 + kp) if kp < 800 else 65536 - int(t * 100),
             "input_volts": 7.4, "timestamp": t, "torque_enable": True} for t in time.tolist()
        ]  # fmt: skip
        (root / path).write_text(json.dumps({"kp": kp, "trajectory": name, "entries": entries}))


MAKE = {"ball_drops": balls, "cube_contactnets": cube, "pendulum_multiarm": pendulum, "servo_xl330": servo}


@pytest.fixture(scope="module", params=NAMES)
def fetched(request, tmp_path_factory) -> tuple[str, Path, Path]:
    """A data set's name, its mirror, and the study that was made of it."""
    folder = tmp_path_factory.mktemp(request.param)
    MAKE[request.param](mirror_of(request.param, folder / "mirror"))
    out = folder / "study"
    code, said = run("fetch", request.param, "--out", str(out), "--mirror", str(folder / "mirror"), "--unverified")
    assert code == 0, said
    return request.param, folder / "mirror", out


def errors(said: list[str]) -> list[str]:
    return [line for line in said if line.startswith("error: ")]


def _rows(path: Path) -> np.ndarray:
    return np.loadtxt(path, delimiter=",", skiprows=1)


def test_it_is_converted_as_described(fetched):
    name, mirror, out = fetched
    study = load_study(out)
    assert len(study.recordings) + len(study.holdout) == len(fingerprints.known(name))
    made = {f"{r.path.parent.name}/{r.path.stem}" for r in (*study.recordings, *study.holdout)}
    assert made == set(fingerprints.known(name))
    if name == "pendulum_multiarm":
        rows = _rows(out / "holdout" / "swing_5.csv")
        time = 0.004 * np.arange(11)
        np.testing.assert_allclose(
            rows, np.stack([time, np.cos(5 * (15 + time)), -5 * np.sin(5 * (15 + time))], 1), atol=1e-8
        )
    elif name == "ball_drops":
        rows = _rows(out / "recordings" / "baseball_drop1.csv")
        fallen = np.arange(5, 24) / 15  # 0.5 m takes 0.319 s; the last sample is dropped
        np.testing.assert_allclose(rows, np.stack([fallen - fallen[0], 48 - 4.9 * fallen**2], 1), atol=1e-7)
        known = {str(target): value for target, value in study.known["baseball_drop1"].items()}
        np.testing.assert_allclose(known["body/ball/mass"], 0.453592)
        np.testing.assert_allclose(known["geom/ball/size"], [0.5, 0, 0])
    elif name == "cube_contactnets":
        rows = _rows(out / "recordings" / "toss_00.csv")
        time = 0.0068 * np.arange(8)
        np.testing.assert_allclose(rows[:, 4], np.cos(2 * time), atol=1e-6)  # of one sign
        np.testing.assert_allclose(rows[:, 10], 3 - 9.81 * (time + 0.0034), atol=1e-6)
    else:
        rows = _rows(out / "recordings" / "kp100_lift_and_drop.csv")
        assert rows[-1, 0] <= 2.0 and len(_rows(out / "recordings" / "kp100_sin_sin.csv")) > len(rows)
        np.testing.assert_allclose(rows[:, 1], np.sin(3 * (0.0035 + 0.005 + 0.0024 + rows[:, 0])), atol=4e-5)
        driven = _rows(out / "recordings" / "kp800_sin_sin.csv")[:, 2]
        assert np.all(driven <= 0) and driven[-1] == pytest.approx(-220 / 885 * 7.4, abs=0.02)


def test_files_that_are_not_the_published_ones_are_refused(fetched, tmp_path):
    name, mirror, _ = fetched
    code, said = run("fetch", name, "--out", str(tmp_path / "study"), "--mirror", mirror.as_uri())
    assert code == 2 and len(errors(said)) == 1 and "not those of the pinned commit" in said[-1], said
    assert not (tmp_path / "study").exists()


def test_source_md_has_the_checksums(fetched):
    name, mirror, out = fetched
    data, told = get_dataset(name), (out / "SOURCE.md").read_text()
    for path in data.files:
        assert f"{path}: {sha256(mirror / data.repository / data.commit / path)}" in told
    assert data.commit in told and data.license in told


def test_a_known_checksum_is_held_against_a_file(tmp_path, monkeypatch):
    data = get_dataset("pendulum_multiarm")
    pendulum(mirror_of(data.name, tmp_path))
    address = f"{data.repository}/{data.commit}/{data.files[0]}"
    monkeypatch.setattr(download, "known_checksums", lambda: {address: "0" * 64})
    with pytest.raises(SourceError, match="found SHA-256 .* allowed: 0000"):
        download.download(data, str(tmp_path), tmp_path / "into")
    monkeypatch.setattr(download, "known_checksums", lambda: {address: sha256(tmp_path / address)})
    assert download.download(data, str(tmp_path), tmp_path / "into")[2] == 1


@pytest.fixture
def served(tmp_path):
    """A mirror of the pendulum over HTTP on this machine, and its folder."""
    pendulum(mirror_of("pendulum_multiarm", tmp_path / "mirror"))
    handler = partial(SimpleHTTPRequestHandler, directory=str(tmp_path / "mirror"))
    handler.func.log_message = lambda *_: None
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}", tmp_path / "mirror"
        server.shutdown()


def test_a_proved_download_locks_what_later_ones_have_to_be(served, tmp_path, monkeypatch):
    url, mirror = served
    monkeypatch.setattr(download, "PUBLIC", url)
    monkeypatch.setattr(download, "_cache", lambda: tmp_path / "cache")
    data = get_dataset("pendulum_multiarm")
    address = Path(data.repository, data.commit)
    code, said = run("fetch", data.name, "--out", str(tmp_path / "first"))
    assert code == 2 and "not those of the pinned commit" in said[-1]
    assert not (tmp_path / "cache" / address).exists()  # it is downloaded anew the next time
    made = fingerprints.of_study
    assert run("fetch", data.name, "--out", str(tmp_path / "first"), "--unverified")[0] == 0
    monkeypatch.setattr(fetch, "known", lambda name: made(tmp_path / "first"))
    assert run("fetch", data.name, "--out", str(tmp_path / "second"))[0] == 0
    files, sums, known = download.download(data, None, tmp_path)  # from the cache
    assert known == 1 and json.loads((tmp_path / "cache" / address / "sha256.json").read_text()) == sums
    (mirror / address / data.files[0]).write_bytes(b"another content")
    next(iter(files.values())).unlink()
    with pytest.raises(SourceError, match="another content than SHA-256"):
        download.download(data, None, tmp_path)


def test_a_mirror_may_be_a_url_and_lack_a_file(served, tmp_path):
    url, mirror = served
    assert run("fetch", "pendulum_multiarm", "--out", str(tmp_path / "a"), "--mirror", url, "--unverified")[0] == 0
    code, said = run("fetch", "servo_xl330", "--out", str(tmp_path / "b"), "--mirror", url)
    assert code == 2 and "404" in said[-1] and "allowed: a file that is there" in said[-1]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("penduluum",), "NAME: found 'penduluum'; did you mean 'pendulum_multiarm'? allowed: "),
        (("servo_xl330", "--mirror", "nowhere"), "--mirror nowhere: no such folder"),
        (("servo_xl330", "--mirror", "."), "no Rhoban/bam/af226"),
        (("servo_xl330", "--mirror", "http://127.0.0.1:9"), "cannot be downloaded (no network); allowed: a connection"),
    ],
)
def test_what_cannot_be_fetched_is_told(tmp_path, monkeypatch, arguments, told):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    code, said = run("fetch", *arguments, "--out", str(tmp_path / "study"))
    assert code == 2 and len(errors(said)) == 1 and told in said[-1], said
    assert not (tmp_path / "study").exists()


def test_a_pickle_that_calls_something_else_is_refused(tmp_path):
    values = np.arange(6.0).reshape(2, 3)
    torch_file(tmp_path / "good.pt", values)
    np.testing.assert_array_equal(read_tensor(tmp_path / "good.pt"), values)
    torch_file(tmp_path / "bad.pt", values, call=("os", "system"))
    with pytest.raises(SourceError, match="refused: it asks for os.system"):
        read_tensor(tmp_path / "bad.pt")
    with zipfile.ZipFile(tmp_path / "other.pt", "w") as archive:
        archive.writestr("archive/data.pkl", pickle.dumps(OrderedDict(a=1)))
    with pytest.raises(SourceError, match="found a OrderedDict; allowed: one tensor"):
        read_tensor(tmp_path / "other.pt")
    (tmp_path / "plain.pt").write_bytes(pickle.dumps(values))
    with pytest.raises(SourceError, match="refused"):
        read_tensor(tmp_path / "plain.pt")
