"""The page over a folder of results: what it finds, what it refuses, and how the command ends."""

import http.client
import json
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from made_results import write_results

from det2stoc_bayes.errors import Det2StocError
from det2stoc_bayes.report import results
from det2stoc_bayes.report.results_page import beside_page
from det2stoc_bayes.server import Results


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    above = tmp_path_factory.mktemp("above")
    (above / "secret.json").write_text("{}")
    folder = write_results(above / "results")
    (folder / "out").symlink_to(above)
    (folder / "first" / "link.json").symlink_to(above / "secret.json")
    return folder


@pytest.fixture(scope="module")
def port(root: Path) -> Iterator[int]:
    with Results(root, port=0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server.server_port
        server.shutdown()


def _ask(port: int, path: str, method: str = "GET", host: str = "localhost") -> tuple[int, str, dict[str, str]]:
    line = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    line.request(method, path, headers={"Host": f"{host}:{port}"})
    answer = line.getresponse()
    return answer.status, answer.read().decode("utf-8", "replace"), dict(answer.getheaders())


def test_every_kind_is_found_and_said_in_a_line(root) -> None:
    found = {result.folder: result for result in results.find(root)}
    assert set(found) == {"first", "second", "methods", "ranks", "hidden_effects", "broken", "old"}
    kinds = {folder: result.kind for folder, result in found.items()}
    assert kinds["methods"] == "comparison" and kinds["ranks"] == "calibration" and kinds["old"] == "reproduction"
    assert (
        found["first"].verdict == "mismatch"
        and found["hidden_effects"].headline == "1 of 2 concealed studies told right"
    )
    assert found["broken"].verdict == "unreadable" and found["broken"].headline.startswith(
        "diagnosis.json lacks the key"
    )
    with pytest.raises(Det2StocError, match="found no result; allowed: a folder with one of diagnosis.json"):
        results.read(root, "nothing")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b'{"verdict": "mismatch"}', "lacks the key '"),
        (b"[]", "has values of another kind than det2stoc writes"),
        (b'{"verdict": ', "is no JSON: "),
        (b"\xff\xfe{", "is no text in UTF-8"),
    ],
)
def test_damaged_files_say_what_is_wrong(tmp_path, content, said) -> None:
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "diagnosis.json").write_bytes(content)
    (result,) = results.find(tmp_path)
    assert result.verdict == "unreadable" and said in result.headline


def test_two_runs_stand_side_by_side(root) -> None:
    text = beside_page(results.read(root, "first"), results.read(root, "second"))
    row = text[text.index('<th scope="row">mass, before</th>') :]
    row = row[: row.index("</tr>")]
    assert "1.90 ± 0.10" in row and "2.40 ± 0.10" in row and row.count("span-bar") == 2
    assert "left:0.0%;width:43.9%" in row  # 0.392 of 0.892
    seed = text[: text.index('<th scope="row">seed</th>')].rsplit("<tr", 1)[1]
    assert "differs" not in seed


@pytest.mark.parametrize(
    "path",
    [
        "/files/../secret.json",
        "/files/%2e%2e/secret.json",
        "/files/first/..%2f..%2fsecret.json",
        "/files//etc/passwd",
        "/files/%2Fetc/hostname.txt",
        "/files/out/secret.json",
        "/files/first/link.json",
        "/files/.hidden/report.html",
        "/files/first/notes.bin",
        "/files/first",
        "/files/first/report.html%00.html",
        "/files/..%5csecret.json",
        "/compare?a=..&b=first",
        "/compare?a=out&b=first",
        "/compare?a=first",
        "/compare?a=first&b=%00",
        "/etc/passwd",
        "/first/report.html",
    ],
)
def test_what_is_not_below_the_folder_is_refused(port, path) -> None:
    status, text, _ = _ask(port, path)
    assert status == 404 and text.startswith("404: ") and "root:" not in text


def test_files_come_as_what_they_are_and_see_nothing_else(port) -> None:
    status, text, told = _ask(port, "/files/first/report.html")
    assert status == 200 and text == "<p>first</p>" and told["Content-Type"].startswith("text/html")
    assert "sandbox" in told["Content-Security-Policy"] and told["X-Content-Type-Options"] == "nosniff"
    status, text, told = _ask(port, "/files/first/effects.py")
    assert status == 200 and told["Content-Type"].startswith("text/plain")
    assert _ask(port, "/", "HEAD")[:2] == (200, "")
    assert _ask(port, "/", "POST")[0] == 501
    assert _ask(port, "/", host="elsewhere.example")[0] == 403


def test_names_stay_text(root, tmp_path) -> None:
    evil = tmp_path / "<img src=x onerror=alert(1)>"
    evil.mkdir()
    (evil / "results.json").write_text(json.dumps({"experiment": "<script>alert(1)</script>"}))
    with Results(tmp_path, port=0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        text = _ask(server.server_port, "/")[1]
        server.shutdown()
    assert "<img" not in text and "<script>alert" not in text and "&lt;script&gt;" in text


def test_the_command_ends_cleanly_and_tells_a_port_in_use(root) -> None:
    command = [sys.executable, "-m", "det2stoc_bayes", "serve", str(root), "--port"]
    running = subprocess.Popen([*command, "0"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert running.stdout is not None
        line = running.stdout.readline()
        port = int(line.rsplit(":", 1)[1].split("/")[0])
        assert _ask(port, "/")[0] == 200
        second = subprocess.run([*command, str(port)], capture_output=True, text=True, timeout=100)
        assert second.returncode == 2 and second.stdout == ""
        said = f"error: --port {port}: found in use on 127.0.0.1; allowed: another one, or 0 for any that is free\n"
        assert second.stderr == said
        running.send_signal(signal.SIGINT)
        out, error = running.communicate(timeout=60)
        assert (running.returncode, out, error) == (0, "ended\n", "")
    finally:
        running.kill()
    with socket.socket() as free:
        free.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # connections that are closing
        free.bind(("127.0.0.1", port))


def test_a_folder_and_an_address_are_checked(tmp_path) -> None:
    with pytest.raises(Det2StocError, match="found no folder; allowed: one with results"):
        Results(tmp_path / "none")
    with pytest.raises(Det2StocError, match="--host 192.0.2.1: found no address of this machine"):
        Results(tmp_path, "192.0.2.1", 0)
