"""`--fail-on`: what is parsed, what is refused, what exceeds a limit."""

from __future__ import annotations

import pytest

from mlbatch.errors import UsageError
from mlbatch.reports.limits import exceeded, not_covered, parse_limits
from mlbatch.reports.report import RunReport

REPORT = RunReport.from_json(
    {
        "sensors": [
            {"name": "a", "packets": {"read": 999, "accepted": 999, "lost": 1, "rejected": {}}},
            {
                "name": "b",
                "packets": {
                    "read": 1000,
                    "accepted": 990,
                    "lost": 10,
                    "rejected": {"bad_crc": 7, "duplicate": 3},
                },
            },
        ],
        "scans": {
            **{"written": 40, "underfilled": 2, "incomplete": 0, "empty": 3, "empty_clouds": 0},
            **{"dropped_incomplete": 4, "no_points": {"b": 5}},
        },
        "poses": {
            "pairs": [
                {"lidars": ["a", "c"], "outcome": "not checked", "reason": "seen nothing"},
                {
                    **{"lidars": ["a", "b"], "outcome": "off", "overlap_percent": 41.2},
                    **{"shift_mm": 31.0, "shift_deviation_mm": 2.0},
                    **{"turn_deg": 0.4, "turn_deviation_deg": 0.01},
                    "undetermined": ["shift along x"],
                },
            ]
        },
        "warnings": [{"code": "clouds"}, {"code": "loss"}, {"code": "cut_off"}],
    }
)
APART = (
    "a and b have 41 % of their surfaces in common; double walls: b is 31 mm / 0.40 degrees off "
    "(this check does not determine: shift along x)"
)
EXCEEDED = [
    # 10 of 1000 of b, 1 of 1000 of a.
    ("loss>0.99%", "loss>0.99%: found b: 10 of 1000 (1 %) packets lost"),
    ("loss>1%", ""),
    ("loss>0.09%", "loss>0.09%: found a: 1 of 1000 (0.1 %) packets lost"),
    ("loss>9", "loss>9: found b: 10 of 1000 (1 %) packets lost"),
    ("rejected>0", "rejected>0: found b: 10 of 1000 (1 %) packets rejected"),
    ("rejected>1%", ""),
    ("underfilled>1", "underfilled>1: found 2 of 40 (5 %) scans underfilled"),
    ("underfilled>5%", ""),
    ("underfilled > 4.9 %", "underfilled > 4.9 %: found 2 of 40 (5 %) scans underfilled"),
    ("incomplete>0", ""),
    ("empty>2", "empty>2: found 3 windows empty"),
    ("dropped_incomplete>3", "dropped_incomplete>3: found 4 windows left out"),
    ("empty_clouds>0", ""),
    ("no_points>12%", "no_points>12%: found b: 5 of 40 (12.5 %) scans without its points"),
    # `clouds` is for information.
    ("warnings>1", "warnings>1: found 2 warnings"),
    ("warnings>2", ""),
    ("cut_off>0", "cut_off>0: found 1 recordings cut off"),
    ("cut_off>1", ""),
    # By two standard deviations: 27 mm, 0.38 degrees.
    ("pose>2.6cm", f"pose>2.6cm: found {APART}"),
    ("pose>26 mm", f"pose>26 mm: found {APART}"),
    ("pose>28mm", ""),
    ("pose>0.03m", ""),
    ("pose>0.37deg", f"pose>0.37deg: found {APART}"),
    ("pose>0.39deg", ""),
]


@pytest.mark.parametrize(("text", "line"), EXCEEDED)
def test_limits_by_hand(text: str, line: str) -> None:
    assert exceeded(parse_limits([text]), REPORT) == ([line] if line else [])


def test_what_a_limit_of_poses_does_not_cover_is_said() -> None:
    assert not_covered(parse_limits(["pose>5cm,loss>1"]), REPORT) == [
        "pose>5cm: a and c: not checked, since seen nothing",
        "pose>5cm: a and b: the scene does not determine shift along x",
    ]
    assert not_covered(parse_limits(["loss>1"]), REPORT) == []


def test_limits_may_be_in_one_list_or_in_several() -> None:
    limits = parse_limits(["loss>0.1%,underfilled>0", "warnings>0"])
    assert [limit.text for limit in limits] == ["loss>0.1%", "underfilled>0", "warnings>0"]
    assert len(exceeded(limits, REPORT)) == 3


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("lost>1", "expected one of loss, rejected, underfilled, .*, found 'lost'; write loss>"),
        ("loss", "expected NAME>NUMBER or NAME>NUMBER%, found 'loss'"),
        ("loss<1", "expected NAME>NUMBER or NAME>NUMBER%, found 'loss<1'"),
        ("loss>-1", "expected NAME>NUMBER or NAME>NUMBER%, found 'loss>-1'"),
        ("loss>1e3", "expected NAME>NUMBER"),
        ("", "expected NAME>NUMBER or NAME>NUMBER%, found ''"),
        ("loss>1,", "expected NAME>NUMBER or NAME>NUMBER%, found ''"),
        ("pose>1", "expected pose>NUMBER with mm, cm, m or deg, found 'pose>1'; write pose>5cm"),
        ("pose>1%", "expected pose>NUMBER with mm, cm, m or deg, found 'pose>1%'"),
        ("loss>1cm", "expected a number of packets lost, found 'loss>1cm'; write loss>1"),
        ("warnings>1%", "expected a number of warnings, found 'warnings>1%'; write warnings>1"),
    ],
)
def test_other_texts_are_refused(text: str, found: str) -> None:
    with pytest.raises(UsageError, match=f"--fail-on: {found}"):
        parse_limits([text])
