"""Every damage is found, and named with its place: the rows of `damage.txt`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from mlbatch.verification import VerifyError
from tests.builders.verify_outputs import damaged
from tests.verification.edits import edit_of

ROWS = [
    [part.strip() for part in f"{line} ".split(" | ")]
    for line in Path(__file__).with_name("damage.txt").read_text(encoding="utf-8").splitlines()
    if line and not line.startswith("#")
]


def cases() -> list[Any]:
    """A case for each kind of a row; `.*`: the suffix of its files."""
    return [
        pytest.param(
            kind,
            *(part.replace(".*", f".{kind.partition('-')[0]}") for part in rest),
            id=f"{kind}-{name}",
        )
        for kinds, name, *rest in ROWS
        for kind in kinds.split()
    ]


@pytest.mark.parametrize(("kind", "edit", "check", "where"), cases())
def test_damage_is_found(kind: str, edit: str, check: str, where: str, tmp_path: Path) -> None:
    """The edit gives a violation of this check that names this place, or is refused in a line."""
    if kind in ("las", "laz"):
        pytest.importorskip("laspy")
        pytest.importorskip("lazrs")
    if check == "refused":
        with pytest.raises(VerifyError, match=where) as error:
            damaged(kind, tmp_path, edit_of(edit))
        assert "\n" not in str(error.value)
        assert str(tmp_path) in str(error.value)
        return
    found = damaged(kind, tmp_path, edit_of(edit)).violations
    # After `~`: words of the violation.
    texts = [str(one) if where[:1] == "~" else one.where for one in found if one.check == check]
    assert any(where.removeprefix("~") in text for text in texts), found
