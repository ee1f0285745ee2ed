"""`--start` and `--end` that are no times of the recording."""

from __future__ import annotations

from pathlib import Path

import pytest

from mlbatch.batching.windows import Limit
from mlbatch.errors import UsageError
from mlbatch.pipeline.time_limits import refuse_outside
from tests.builders.sessions import NS_PER_MS, NS_PER_S, Shell, Unit, names, write_session

# 2027-01-15 08:00:00 UTC is 1800000000; the first stamp of a unit is 20 ms later.
BEGIN_S = 1_800_000_000
DAY_S = 86_400


def _unit(begin_s: int, turns: int = 10) -> Unit:
    """A lidar whose packets are received at 1800000000 s, whatever it counts."""
    begin_ns = begin_s * NS_PER_S + 20 * NS_PER_MS
    return Unit(begin_ns=begin_ns, host_ns=(BEGIN_S - begin_s) * NS_PER_S, turns=turns)


def test_later_segments_need_not_contain_the_limits(shell: Shell, tmp_path: Path) -> None:
    """The clock goes back by 800 s: what is after the step would be long after `--start`."""
    write_session(tmp_path, _unit(866, turns=40))
    words = "--fault jump:ouster_111:500s@2s --on-jump split --start 866.5"
    outcome = shell(f"convert drive.pcap -o out {words}")
    assert outcome.code == 0, outcome.err
    assert len(names("out.seg1")) >= 10
    assert len(names("out.seg2")) >= 10


@pytest.mark.parametrize(
    ("first_s", "start_s", "is_legal"),
    [
        (BEGIN_S, BEGIN_S - DAY_S, True),
        (BEGIN_S, BEGIN_S - DAY_S - 1, False),
        (500, 496, True),
        (500, 495, False),
        (30, 10, False),
        (3, 0, True),
        (500, 10_000, True),
    ],
)
def test_how_early_a_start_may_be(first_s: int, start_s: int, is_legal: bool) -> None:
    limit = Limit(start_s * NS_PER_S)
    if is_legal:
        refuse_outside(limit, None, first_s * NS_PER_S)
        return
    with pytest.raises(UsageError, match="--start: expected a time of the recording"):
        refuse_outside(limit, None, first_s * NS_PER_S)
