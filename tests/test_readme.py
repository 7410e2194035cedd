"""The README says what is there."""

import re
from pathlib import Path

import pytest
import yaml

from deepracer_exp.config.options import groups, options

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
ROWS = {row[0]: row[1] for row in re.findall(r"^\| `(\w+)` \| (.*) \| .* \|$", README, re.MULTILINE)}


@pytest.mark.parametrize("group", groups())
def test_the_table_of_groups_names_every_option_and_no_other(group):
    known = (
        options(group) if group != "track" else [path.stem for path in (ROOT / "conf/track").glob("*.yaml")]
    )
    assert sorted(re.findall(r"`([\w]+)`", ROWS[group])) == sorted(known)


def test_the_bold_options_are_the_defaults():
    defaults = yaml.safe_load((ROOT / "conf" / "train.yaml").read_text(encoding="utf-8"))["defaults"]
    chosen = {g: o for entry in defaults if isinstance(entry, dict) for g, o in entry.items() if o}
    assert {group: re.findall(r"\*\*`(\w+)`\*\*", row) for group, row in ROWS.items() if "**" in row} == {
        group: [option] for group, option in chosen.items()
    }


def test_every_file_the_readme_points_at_exists():
    for link in re.findall(r"\]\(([^)#]+)\)", README):
        assert (ROOT / link).is_file(), link
