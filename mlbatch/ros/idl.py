"""Message definitions written as OMG IDL 4.2, as ROS 2 derives them (schema encoding `ros2idl`).

Only what generated files contain: modules, structs, typedefs of arrays, sequences and strings.
"""

from __future__ import annotations

import re

from mlbatch.ros.definitions import PRIMITIVES, SEQUENCE, Field, resolve

# Unclosed text extends to the end: trying again at every place would take hours.
_NOISE = re.compile(
    r"//[^\n]*|/\*.*?(?:\*/|\Z)|^[ \t]*#[^\n]*|^=+\s*$|^IDL:[^\n]*"
    r"|@\w+\s*(\((\"(\\.|[^\"\\])*(?:\"|\\?\Z)|[^()\"])*\)?)?",
    re.MULTILINE | re.DOTALL,
)
_TOKEN = re.compile(r"\"(?:\\.|[^\"\\])*(?:\"|\\?\Z)|[\w:.+-]+|[{}<>\[\];,=()]")
_MOST_DIGITS = 12
_WORDS = {
    "boolean": "bool",
    "octet": "uint8",
    "float": "float32",
    "double": "float64",
    "short": "int16",
    "long": "int32",
    "long long": "int64",
    "unsigned short": "uint16",
    "unsigned long": "uint32",
    "unsigned long long": "uint64",
}


def parse_idl(text: str) -> dict[str, tuple[Field, ...]]:
    """Types of an IDL text; everything but structs and typedefs is ignored."""
    found: dict[str, tuple[Field, ...]] = {}
    aliases: dict[str, Field] = {}
    scope: list[str] = []
    statement: list[str] = []
    fields: list[Field] | None = None
    for token in _TOKEN.findall(_NOISE.sub(" ", text)):
        if token == "{":
            scope.append(statement[-1] if statement else "")
            fields = [] if statement[:1] == ["struct"] else fields
        elif token == "}" and scope:
            name = scope.pop()
            if fields is not None:
                found[f"{scope[0] if scope else ''}/{name}"] = tuple(fields)
                fields = None
        elif token != ";":
            statement.append(token)
            continue
        elif statement[:1] == ["typedef"] and len(statement) > 2:
            alias = _member(statement[1:], scope, aliases)
            aliases[alias.name] = alias
        elif fields is not None and statement:
            fields.append(_member(statement, scope, aliases))
        statement = []
    return found


def _member(words: list[str], scope: list[str], aliases: dict[str, Field]) -> Field:
    """A field (or typedef) from its words: type, name and perhaps [count]."""
    count: int | None = None
    if words[-1] == "]" and len(words) > 4 and words[-2].isdecimal():
        count = int(words[-2][:_MOST_DIGITS])
        words = words[:-3]
    name = words[-1]
    kind = words[:-1]
    if kind[:2] == ["sequence", "<"]:
        kind = kind[2:-1]
        count = SEQUENCE
        kind = kind[: kind.index(",")] if "," in kind else kind
    kind = kind[: kind.index("<")] if "<" in kind else kind
    text = " ".join(kind)
    alias = aliases.get(text.rpartition("::")[2])
    if alias is not None:
        return Field(name, alias.type, alias.count if count is None else count)
    word = _WORDS.get(text, text)
    package = scope[0] if scope else ""
    return Field(
        name, word if word in PRIMITIVES else resolve(word.replace("::", "/"), package), count
    )
