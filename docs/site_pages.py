"""Pages of the site that are made of others, and links of the repository as links of the site.

A hook of mkdocs (mkdocs.yml); tests import it for the anchors of the made pages.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from typer.main import get_command

from mlbatch.cli.app import COMMANDS, command_line
from mlbatch.cli.help import HELP_ALL
from mlbatch.page.findings import REMEDIES

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
# Files of the repository that are pages of the site.
ADOPTED = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
}
_LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s#:]+)(#[^)\s]*)?\)")
_CODE = re.compile(r"`[^`\n]+`")
_ROW = re.compile(r"^\| `(\w+)` \| (.+) \|$", re.MULTILINE)


def made_pages() -> dict[str, str]:
    """Return the text of every page that has no file in docs/, by its path there."""
    adopted = {
        target: _relinked((ROOT / source).read_text(encoding="utf-8"), ROOT, DOCS)
        for source, target in ADOPTED.items()
    }
    return {
        **adopted,
        "reference/options.md": options_page(),
        "reference/warnings.md": warnings_page(),
    }


class HelpRows:
    """Takes the place of a formatter of help: keeps the rows of each section."""

    def __init__(self) -> None:
        self.groups: dict[str, list[tuple[str, str]]] = {}
        self._title = ""

    @contextmanager
    def section(self, title: str) -> Iterator[None]:
        """A section of the help."""
        self._title = title
        yield

    def write_dl(self, rows: list[tuple[str, str]]) -> None:
        """Names and help of parameters."""
        self.groups.setdefault(self._title, []).extend(rows)


def options_page() -> str:
    """Return the options of all commands, as `--help` has them."""
    commands = getattr(get_command(command_line()), "commands")  # noqa: B009 - typer hides its type
    parts = [
        "# Options of all commands\n\n",
        "Generated from the commands. Rules, limits, exit codes: [commands](../commands.md).\n",
    ]
    for name in COMMANDS:
        command = commands[name]
        context = command.make_context(name, [HELP_ALL], resilient_parsing=True)
        usage = " ".join(["mlbatch", name, *command.collect_usage_pieces(context)])
        help_rows = HelpRows()
        command.format_options(context, help_rows)
        about = " ".join((command.help or "").split())
        parts.append(f"\n## mlbatch {name}\n\n{about}\n\n`{usage}`\n")
        for title, rows in help_rows.groups.items():
            parts.append(f"\n| {title.lower()} | meaning |\n|---|---|\n")
            parts += [f"| `{_cell(names)}` | {_plain(_cell(text))} |\n" for names, text in rows]
    return "".join(parts)


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def _plain(text: str) -> str:
    """Text in which neither < nor [ has a meaning: ranges of numbers are not links."""
    return text.replace("<", "&lt;").replace("[", "&#91;")


def warnings_page() -> str:
    """Return a section for each warning: the meaning of the report's page, and the remedy."""
    report = (DOCS / "report.md").read_text(encoding="utf-8")
    _, _, table = report.partition("### warnings\n")
    parts = [
        "# Warnings\n\n",
        "Codes of the [report](../report.md#warnings), on stderr and on the [page](../page.md) of ",
        "a run. With `--strict` each is an error, except `clouds` and `identity_extrinsics`. ",
        "Errors: [errors](errors.md).\n",
    ]
    for code, meaning in _ROW.findall(table):
        parts.append(f"\n## {code}\n\n{_relinked(_sentence(meaning), DOCS, DOCS / 'reference')}\n")
        if code in REMEDIES:
            parts.append(f"\n**What to do:** {REMEDIES[code].replace('<', '&lt;')}.\n")
    return "".join(parts)


def _sentence(text: str) -> str:
    first = text[0] if text.startswith("`") else text[0].upper()
    return first + text[1:] + ("" if text.endswith(".") else ".")


def _relinked(text: str, old: Path, new: Path) -> str:
    """Return a text of folder `old` with links for folder `new` of the site.

    Files outside docs/ have no page: only their name is left.
    """

    def link(found: re.Match[str]) -> str:
        image, label, target, anchor = found[1], found[2], found[3], found[4] or ""
        path = (old / target).resolve()
        if path.parent == ROOT and path.name in ADOPTED:
            path = DOCS / ADOPTED[path.name]
        if not path.is_relative_to(DOCS):
            return label
        depth = len(new.relative_to(DOCS).parts)
        return f"{image}[{label}]({'../' * depth}{path.relative_to(DOCS).as_posix()}{anchor})"

    return _LINK.sub(link, text)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the made pages."""
    from mkdocs.structure.files import File

    for path, text in made_pages().items():
        files.append(File.generated(config, path, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Remove links to files outside the site; give every row of a code its anchor."""
    path = page.file.src_uri
    if path not in made_pages():
        folder = (DOCS / path).parent
        markdown = _relinked(markdown, folder, folder)
    if path == "report.md":
        markdown = anchored(markdown)
    return with_plain_bars(markdown)


def with_plain_bars(markdown: str) -> str:
    """Return a page whose table cells have `a|b` for the `a\\|b` that Git hosts need in code."""
    return _CODE.sub(lambda found: found[0].replace("\\|", "|"), markdown)


def anchored(markdown: str) -> str:
    """Return the report's page with an anchor for each reason: section-reason."""
    section = ""
    lines = []
    for line in markdown.splitlines():
        heading = re.match(r"#+ (.+)", line)
        section = heading[1].lower() if heading else section
        row = re.match(r"\| `(\w+)` \|", line)
        if row and section != "warnings":
            line = line.replace("| `", f'| <a id="{section}-{row[1]}"></a>`', 1)
        lines.append(line)
    return "\n".join(lines) + "\n"
