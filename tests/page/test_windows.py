"""Windows of a page, from scans.csv."""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.errors import ExportError
from mlbatch.page.windows import MOST_CELLS, Windows, read_windows, summarise
from tests.page.runs import PERIOD_NS, START_NS, table


def windows(
    columns: list[list[int]],
    expected: int | None = None,
    names: tuple[str, ...] = ("left", "right"),
) -> Windows:
    found = read_windows(table(names, columns, expected), 1)
    assert found is not None
    return found


def test_fill_is_columns_per_expected_column() -> None:
    found = windows([[512, 256], [384, 0], [512, 512]], 512)
    np.testing.assert_array_equal(found.fill, [[1.0, 0.5], [0.75, 0.0], [1.0, 1.0]])
    np.testing.assert_array_equal(found.expected, np.full((3, 2), 512))
    assert not found.estimated.any()
    assert found.worst() == 1


def test_a_grid_that_cuts_between_two_columns_is_no_loss() -> None:
    found = windows([[512, 511], [512, 510]], 512)
    np.testing.assert_array_equal(found.fill, [[1.0, 1.0], [1.0, 510 / 512]])


def test_unknown_expectations_are_the_median_of_windows_with_columns() -> None:
    found = windows([[512, 0], [512, 500], [256, 510], [512, 505]])
    np.testing.assert_array_equal(found.expected[0], [512, 505])
    assert found.estimated.all()
    assert found.fill[0, 1] == 0.0
    assert found.fill[2, 0] == 0.5
    # 500 of 505 columns: the pace of a rotor varies by as much.
    assert found.fill[1, 1] == 1.0


def test_windows_have_gap_delay_and_span() -> None:
    found = windows([[512, 0]])
    assert found.gap_ms[0, 0] == pytest.approx(0.1953)
    assert found.delay_ms[0] == 2.0
    assert found.span_ms[0] == pytest.approx(99.8)


def test_the_fill_of_the_table_counts() -> None:
    """A lidar that is dark in a part of the revolution has fewer columns than its rate says.

    A single column less is the grid between two columns, in the table as well.
    """
    text = table(("left",), [[256], [512], [511], [510]], 512)
    ready_ns = START_NS + PERIOD_NS + 2_000_000
    text = text.replace(f",256,{ready_ns}", f",0,{ready_ns}")
    head, *rows = text.splitlines()
    fills = ("0.5", "", "0.998", "0.996")
    cells = [f"{row},{fill}" for row, fill in zip(rows, fills, strict=True)]
    found = read_windows("\n".join([f"{head},fill_left", *cells]), 1)
    assert found is not None
    np.testing.assert_array_equal(found.fill, [[0.5], [1.0], [1.0], [0.996]])


def test_the_worst_window_is_neither_head_nor_tail() -> None:
    columns = [[100, 100], [512, 512], [512, 300], [512, 512], [512, 0]]
    found = read_windows(table(("left", "right"), columns, 512, has_head=True), 1)
    assert found is not None
    assert found.has_head
    assert found.worst() == 2


@pytest.mark.parametrize(("late_ns", "far_ms"), [(2_000_000, 0.0), (10**17, 1e11)])
def test_a_clock_of_another_date_is_no_delay(late_ns: int, far_ms: float) -> None:
    text = table(("left",), [[512], [512]])
    ends = [START_NS + (index + 1) * PERIOD_NS for index in range(2)]
    for end_ns in ends:
        text = text.replace(f",{end_ns + 2_000_000}\n", f",{end_ns + late_ns}\n")
    found = read_windows(text, 1)
    assert found is not None
    assert found.far_ms == far_ms


def test_long_runs_are_summarised_by_their_worst_windows() -> None:
    rows = MOST_CELLS
    columns = [[512, 512]] * rows
    columns[1001] = [512, 128]
    found = windows(columns, 512)
    summary = summarise(found)
    assert summary.group == 2
    assert len(summary.count) == rows // 2
    # Of windows 1000 and 1001.
    np.testing.assert_array_equal(summary.values["fill"][500], [1.0, 0.25])
    np.testing.assert_array_equal(summary.values["columns"][500], [1024, 640])
    assert summary.incomplete.sum() == 0
    assert summary.count.sum() == rows


def test_partial_windows_alone_have_a_worst_one() -> None:
    found = read_windows(table(("left",), [[100], [50]], 512, has_head=True), 1)
    assert found is not None
    found.complete[-1] = False
    assert found.worst() == 1


def test_slices_beyond_any_number_are_refused() -> None:
    with pytest.raises(ExportError, match=r"scans\.csv: expected up to .* slices, found 1000"):
        read_windows(table(("left",), [[512]]), 10**30)


@pytest.mark.parametrize("text", ["", "index,slice\n"])
def test_no_row_is_no_window(text: str) -> None:
    assert read_windows(text, 1) is None


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("points", "pints"),
        ("512", "x"),
        ("512", "9" * 30),
        ("512,", "512,1,"),
        ("start_ns", "columns_\udcff"),
    ],
)
def test_damage_is_one_line(old: str, new: str) -> None:
    text = table(("left",), [[512], [512]])
    with pytest.raises(ExportError, match=r"scans\.csv.*: expected .* found .*; convert again"):
        read_windows(text.replace(old, new, 1), 1)
