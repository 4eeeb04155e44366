"""Cutting recordings, padding, and the commands that act at each step."""

from pathlib import Path

import numpy as np
import pytest

from det2stoc_bayes.recording import Recording
from det2stoc_bayes.segments import all_columns, cut, from_pieces


def record(name, time, columns=("qpos/a",), values=None, ctrl=None):
    time = np.asarray(time, float)
    values = np.arange(len(time) * len(columns), dtype=float).reshape(len(time), -1) if values is None else values
    ctrl = np.arange(len(time), dtype=float)[:, None] if ctrl is None else ctrl
    return Recording(name, time, tuple(columns), values, ctrl, Path(f"{name}.csv"))


@pytest.mark.parametrize(
    ("length", "num_samples", "lengths"),
    [
        (10, None, [10]),
        (10, 5, [5, 5]),
        (11, 5, [6, 5]),
        (14, 5, [7, 7]),
        (3, 5, [3]),
        (4, 100, [4]),
    ],
)
def test_recordings_are_divided_evenly_and_share_no_sample(length, num_samples, lengths):
    recording = record("r", np.arange(length))
    segments = cut([recording], num_samples)
    kept = [int(s.any(-1).sum()) for s in segments.observed]
    assert sorted(kept) == sorted(lengths)
    np.testing.assert_array_equal(segments.values[segments.observed], recording.values.ravel())
    assert segments.first.tolist() == np.cumsum([0, *kept[:-1]]).tolist()


def test_rows_are_padded_with_the_last_time_and_no_value():
    segments = cut([record("a", [0, 1, 2, 3]), record("b", [5, 6, 7])])
    assert segments.count == 2
    np.testing.assert_array_equal(segments.time, [[0, 1, 2, 3], [5, 6, 7, 7]])
    np.testing.assert_array_equal(segments.observed[1, :, 0], [True, True, True, False])
    assert segments.recording.tolist() == [0, 1]


def test_columns_of_recordings_are_joined_by_name():
    a, b = record("a", [0, 1], ("qpos/a", "qvel/a")), record("b", [0, 1], ("qvel/a", "sensor/s"))
    assert all_columns([a, b]) == ("qpos/a", "qvel/a", "sensor/s")
    segments = cut([a, b])
    np.testing.assert_array_equal(segments.values[0], [[0, 1, np.nan], [2, 3, np.nan]])
    np.testing.assert_array_equal(segments.values[1], [[np.nan, 0, 1], [np.nan, 2, 3]])
    assert cut([a, b], columns=("sensor/s",)).values.shape == (2, 2, 1)


def test_whole_recordings_and_different_cuts_are_told_apart():
    records = [record("a", np.arange(10)), record("b", np.arange(6))]
    whole, halves = cut(records), cut(records, 5)
    part = halves.only(np.array([0, 2]))  # as many as recordings
    assert whole.whole and not halves.whole and not part.whole
    assert part.time.tolist() == [[0, 1, 2, 3, 4, 4], [0, 1, 2, 3, 4, 5]]
    assert part.recording.tolist() == [0, 1] and part.recordings == whole.recordings
    assert len({s.extent for s in (whole, halves, part)}) == 3


@pytest.mark.parametrize(
    ("num_samples", "rows"), [(100, range(10)), (40, range(10)), (20, [1, 3, 5, 7, 9]), (10, [2, 6, 9]), (1, [7, 9])]
)
def test_segments_are_spread_over_each_recording(num_samples, rows):
    segments = cut([record("a", np.arange(32)), record("b", np.arange(8))], 4)
    assert segments.evenly(num_samples).tolist() == list(rows)


def test_longer_segments_begin_with_some_of_the_shorter():
    records = [record("a", np.arange(320)), record("b", np.arange(160))]
    short, long = cut(records, 20), cut(records, 80)
    some = short.only(short.beginnings(4))
    assert some.first.tolist() == long.first.tolist() and some.recording.tolist() == long.recording.tolist()
    assert short.beginnings(100).tolist() == [0, 16]  # one of each recording at least


def test_dropped_samples_are_not_observed():
    values = np.array([[1.0], [np.nan], [3.0]])
    segments = cut([record("a", [0, 1, 2], values=values)])
    assert segments.observed[0, :, 0].tolist() == [True, False, True]


def test_pieces_are_taken_as_given():
    segments = from_pieces(
        [record("a", np.arange(10)), record("b", np.arange(10) + 0.5)], [(1, 2, 5), (0, 7, 9)], ("qpos/a",)
    )
    np.testing.assert_array_equal(segments.time, [[2.5, 3.5, 4.5], [7, 8, 8]])


@pytest.mark.parametrize(
    ("last", "timestep", "expected"),
    [
        (1.0, 0.1, 10),
        (1.0, 0.3, 4),
        (0.3, 0.1, 3),
        (1.0 + 1e-9, 0.1, 10),
        (0.05, 0.1, 1),
        (1.01, 0.1, 11),
    ],
)
def test_steps_reach_the_last_sample(last, timestep, expected):
    assert cut([record("a", [0.0, last])]).steps(timestep).tolist() == [expected]


def test_a_command_within_a_step_counts_for_what_is_left_of_it():
    segments = cut([record("a", [0.0, 0.1, 0.15, 0.31, 0.4])])
    held = segments.commands(np.array([0]), 0.1, 5, 2).each[0, :, 0]
    #          before  0.0  0.1  0.2  0.3 and 0.4
    np.testing.assert_allclose(held, [0, 0, 0, 1.5, 2, 2.9, 4], rtol=0, atol=1e-12)


def test_commands_before_a_later_segment_are_those_recorded_before_it():
    segments = cut([record("a", np.arange(8) * 0.1)], 4)
    assert segments.count == 2
    held = segments.commands(np.array([1, 0, 1]), 0.1, 3, 2).each[:, :, 0]
    np.testing.assert_array_equal(held, [[2, 3, 4, 5, 6], [0, 0, 0, 1, 2], [2, 3, 4, 5, 6]])


def test_times_that_differ_by_rounding_are_the_same():
    time = np.cumsum(np.full(50, 0.01)) - 0.01  # not exactly a multiple of the step
    segments = cut([record("a", time)])
    held = segments.commands(np.array([0]), 0.001, 490).each[0, :, 0]
    np.testing.assert_array_equal(held, np.repeat(np.arange(49), 10))
