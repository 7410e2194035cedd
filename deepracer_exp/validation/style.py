"""The style codes that the AWS console checks."""

import ast
import re
from typing import Any

import pycodestyle
from pyflakes.checker import Checker as Flakes

from .findings import Finding

_IGNORED = ("W", "E5", "E226", "E261")
"""The console runs flake8 with the codes E and F without these (deepracer-on-aws, test_reward_function.py)."""
_NOQA = re.compile(r"#\s*noqa(?::(?P<codes>[\s\w,]+))?", re.IGNORECASE)


class _Report(pycodestyle.BaseReport):
    """Keeps every finding; the base class counts them only."""

    def __init__(self, options: Any) -> None:
        super().__init__(options)
        self.found: list[Finding] = []

    def error(self, line_number: int, offset: int, text: str, check: Any) -> str | None:
        # The base class passes over what is ignored.
        code: str | None = super().error(line_number, offset, text, check)
        if code:
            self.found.append(Finding(line_number, text))
        return code


def style_findings(text: str) -> list[Finding]:
    """Return what flake8's E and F codes find in valid Python: pycodestyle's and pyflakes' messages, by line.

    Lines with a comment `# noqa` are passed over, as flake8 does.
    """
    lines = text.splitlines(keepends=True)
    guide = pycodestyle.StyleGuide(ignore=list(_IGNORED), reporter=_Report)
    pycodestyle.Checker(lines=lines, options=guide.options).check_all()
    found = {(finding, finding.text[:4]) for finding in guide.options.report.found}
    for message in Flakes(ast.parse(text)).messages:
        found.add((Finding(message.lineno, f"F {message.message % message.message_args}"), "F"))
    return sorted(finding for finding, code in found if not _excused(lines, finding.line, code))


def _excused(lines: list[str], line: int, code: str) -> bool:
    match = _NOQA.search(lines[line - 1]) if 0 < line <= len(lines) else None
    if match is None:
        return False
    codes = re.findall(r"[A-Z]+[0-9]*", (match["codes"] or "").upper())
    # pyflakes' messages come without flake8's numbers: any F excuses them.
    return not codes or any(code.startswith(c) if code != "F" else c.startswith("F") for c in codes)
