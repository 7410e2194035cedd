"""Write the catalogue's data file, `deepracer_exp/aws/worlds/worlds.zip`, from route files.

    git clone https://github.com/aws-deepracer-community/deepracer-simapp
    git -C deepracer-simapp checkout 01f5f015fd85
    git clone https://github.com/aws-deepracer-community/deepracer-analysis
    git -C deepracer-analysis checkout 6f8cf6b2f732
    cd deepracer-analysis/tracks && git show fce64302d8a5:./reinvent_base.npy > reinvent_base_2019.npy && cd -
    python -m benchmarks.build_catalogue deepracer-simapp/bundle/routes deepracer-analysis/tracks

The coordinates are those of deepracer-simapp (Apache-2.0, Amazon.com, Inc. or its affiliates) and, for the worlds of
`FORMER`, of deepracer-analysis (MIT-0), rounded to 0.1 mm. The file holds `index.json`, which names sources and
licences and lists the worlds, and `routes.npy`: the rows of all worlds one after another, in units of 0.1 mm, as second
differences along each world (int32). The same routes give the same bytes.
"""

import argparse
import io
import json
import re
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from deepracer_exp.aws.worlds.catalogue import FILE, INDEX, ROUTES, UNITS_PER_M, World
from deepracer_exp.aws.worlds.routes import is_first_of_equals, read_route

SOURCES = (
    {
        "source": "https://github.com/aws-deepracer-community/deepracer-simapp, bundle/routes, commit 01f5f015fd85",
        "licence": "Apache-2.0, Copyright Amazon.com, Inc. or its affiliates",
    },
    {
        "source": "https://github.com/aws-deepracer-community/deepracer-analysis, tracks, commit 6f8cf6b2f732; "
        "reinvent_base_2019: reinvent_base at commit fce64302d8a5",
        "licence": "MIT-0, Copyright 2018-2019 Amazon.com, Inc. or its affiliates, 2019-2022 AWS DeepRacer Community",
    },
)
FORMER = (
    "2022_reinvent_champ",
    "Canada_Eval",
    "China_eval_track",
    "H_track",
    "Mexico_track_eval",
    "New_York_Eval_Track",
    "reinvent_base_2019",
)
"""Worlds of earlier years that deepracer-simapp no longer has. In its time `reinvent_base_2019` was `reinvent_base`."""
VARIANT = re.compile(r"_(?:ccw|cw|mirrored|building|f1)$")
OF_REINVENT_BASE = tuple(f"reinvent_{other}" for other in ("base_2019", "carpet", "concrete", "wood"))
TITLES = {
    # Official names: aws-solutions/deepracer-on-aws, source/libs/config/src/data/tracks.json (Apache-2.0).
    "2022_april_open": "Ace Speedway",
    "2022_april_pro": "Ace Super Speedway",
    "2022_august_open": "Jochem Turnpike",
    "2022_august_pro": "Jochem Highway",
    "2022_july_open": "DBro Raceway",
    "2022_july_pro": "DBro Super Raceway",
    "2022_june_open": "BreadCentric Loop",
    "2022_june_pro": "BreadCentric Speedway",
    "2022_march_open": "Rogue Circuit",
    "2022_march_pro": "Rogue Raceway",
    "2022_may_open": "Ross Raceway",
    "2022_may_pro": "Ross Super Speedway",
    "2022_october_open": "Jennens Family Speedway",
    "2022_october_pro": "Jennens Super Speedway",
    "2022_reinvent_champ": "2022 re:Invent Championship",
    "2022_september_open": "Roger Ring",
    "2022_september_pro": "Roger Super Raceway",
    "2022_summit_speedway": "RL Speedway",
    "2024_reinvent_champ": "Forever Raceway",
    "Albert": "Yun Speedway",
    "AmericasGeneratedInclStart": "Baadal Track",
    "Aragon": "Stratus Loop",
    "Austin": "American Hills Speedway",
    "Belille": "Cumulo Turnpike",
    "Bowtie_track": "Bowtie Track",
    "Canada_Training": "Toronto Turnpike Training",
    "China_track": "Shanghai Sudu Training",
    "FS_June2020": "Fumiaki Loop",
    "July_2020": "Roger Raceway",
    "LGSWide": "SOLA Speedway",
    "Mexico_track": "Cumulo Carrera Training",
    "Monaco": "European Seaside Circuit",
    "Monaco_building": "European Seaside Circuit - Buildings",
    "New_York_Track": "Empire City Training",
    "Oval_track": "Oval Track",
    "Singapore": "Asia Pacific Bay Loop",
    "Singapore_building": "Asia Pacific Bay Loop - Buildings",
    "Spain_track": "Circuit de Barcelona-Catalunya",
    "Tokyo_Training_track": "Kumo Torakku Training",
    "Vegas_track": "AWS Summit Raceway",
    "Virtual_May19_Train_track": "London Loop Training",
    "arctic_open": "Hot Rod Speedway",
    "arctic_pro": "Hot Rod Super Speedway",
    "caecer_gp": "Vivalas Speedway",
    "caecer_loop": "Vivalas Loop",
    "dubai_open": "Baja Turnpike",
    "dubai_pro": "Baja Highway",
    "hamption_open": "Kuei Raceway",
    "hamption_pro": "Kuei Super Raceway",
    "jyllandsringen_open": "Cosmic Loop",
    "jyllandsringen_pro": "Cosmic Circuit",
    "morgan_open": "Playa Raceway",
    "morgan_pro": "Playa Super Raceway",
    "penbay_open": "Po-Chun Speedway",
    "penbay_pro": "Po-Chun Super Speedway",
    "reInvent2019_track": "Smile Speedway",
    "reInvent2019_wide": "A to Z Speedway",
    "red_star_open": "Expedition Loop",
    "red_star_pro": "Expedition Super Loop",
    "reinvent_base": "re:Invent 2018",
    "thunder_hill_open": "Lars Loop",
    "thunder_hill_pro": "Lars Circuit",
    # The races of the Virtual Circuit of 2019, whose trainings have the same titles with "Training" behind them.
    "Canada_Eval": "Toronto Turnpike",
    "China_eval_track": "Shanghai Sudu",
    "Mexico_track_eval": "Cumulo Carrera",
    "New_York_Eval_Track": "Empire City",
    # The service names these nowhere.
    "2022_summit_speedway_mini": "RL Speedway Mini",
    "AWS_track": "AWS Track",
    "H_track": "H Track",
    "reinvent_base_2019": "re:Invent 2018 until 2020",
    "Straight_track": "Straight Track",
}


def build(routes: Path, former: Path) -> bytes:
    """Return the data file's content.

    Args:
        routes: folder of NAME.npy.
        former: likewise, of which the worlds of `FORMER` are taken.

    Raises:
        BadInput: a route cannot be read.
        SystemExit: there is none, a world has no title, or rounding opens a ring or moves a repeated point.
    """
    found: list[tuple[World, np.ndarray]] = []
    for path in (*routes.glob("*.npy"), *(former / f"{name}.npy" for name in FORMER)):
        family = "reinvent_base" if path.stem in OF_REINVENT_BASE else VARIANT.sub("", path.stem)
        title = TITLES.get(path.stem) or TITLES.get(family)
        if title is None:
            raise SystemExit(f"{path}: no title; TITLES has one for every family")
        rows = _closed(read_route(path))
        units = np.rint(rows * UNITS_PER_M).astype(np.int64)
        same_repeats = is_first_of_equals(units / UNITS_PER_M) == is_first_of_equals(rows)
        if not same_repeats.all() or (units[0] == units[-1]).all() != (rows[0] == rows[-1]).all():
            raise SystemExit(f"{path}: rounding changes its shape")
        found.append((World(name=path.stem, family=family, title=title, rows=len(rows)), units))
    if len(found) == len(FORMER):
        raise SystemExit(f"{routes}: no routes (*.npy)")
    found.sort(key=lambda one: (one[0].family, one[0].name))
    bends = [np.diff(np.diff(units, axis=0, prepend=0), axis=0, prepend=0) for _, units in found]
    index = {"sources": SOURCES, "worlds": [world._asdict() for world, _ in found]}
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as file:
        file.writestr(zipfile.ZipInfo(INDEX), json.dumps(index, indent=1), zipfile.ZIP_DEFLATED, 9)
        array = io.BytesIO()
        np.save(array, np.concatenate(bends).astype(np.int32), allow_pickle=False)
        file.writestr(zipfile.ZipInfo(ROUTES), array.getvalue(), zipfile.ZIP_DEFLATED, 9)
    return content.getvalue()


def _closed(rows: np.ndarray) -> np.ndarray:
    """Return a ring's rows with its closing row, which two of deepracer-analysis lack; others as they are.

    Their ends are no farther apart than two neighbouring rows; those of `Straight_track` are 5.7 m apart.
    """
    steps_m = np.linalg.norm(np.diff(rows[:, :2], axis=0), axis=1)
    gap_m = np.linalg.norm(rows[0, :2] - rows[-1, :2])
    return np.vstack([rows, rows[:1]]) if 0 < gap_m < 2 * np.median(steps_m) else rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Build the data file in its place."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        prog="benchmarks.build_catalogue",
    )
    parser.add_argument("routes", type=Path, help="the folder of deepracer-simapp's route files")
    parser.add_argument("former", type=Path, help="the folder of deepracer-analysis' route files")
    parser.add_argument("--output", type=Path, default=FILE, help="where to write it (default: %(default)s)")
    args = parser.parse_args(arguments)
    content = build(args.routes, args.former)
    args.output.write_bytes(content)
    print(f"{args.output}: {len(content):,} bytes")


if __name__ == "__main__":
    main()
