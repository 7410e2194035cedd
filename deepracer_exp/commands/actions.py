"""`deepracer-exp actions`: an action space from driven laps."""

import argparse
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from deepracer_exp.errors import BadInput, writing

from .arguments import Stores, add_command, add_run, complete_runs, read_stores, runs_and_overrides
from .output import print_notes, table_console, warnings_on_stderr
from .pages import existing_logs
from .tracks import ROUTES, experiment_on, search_fastest

if TYPE_CHECKING:
    from deepracer_exp.aws.models.model_metadata import ModelMetadata
    from deepracer_exp.config.car import CarConfig
    from deepracer_exp.reports.tables.proposed_actions import ActionProposal, Commands
    from deepracer_exp.sweeps.plan import LapActions

_EPILOG = """\
  deepracer-exp actions RUN                                 from the fast laps of its best checkpoint, driven now
  deepracer-exp actions ~/Downloads/training.tar.gz --count 20 --name season
                                                            from the fast laps of a log
  deepracer-exp actions Oval_track car=deepracer_v5         from the fastest lap of a car on a track
  deepracer-exp train action_space=season                   train with them

Laps that count are complete, without a reset, and at most 5 % slower than the fastest of their track. Actions are the
centres of clusters of what these commanded, where 10 degrees of steering count as much as 1 m/s. To recover with, where
nothing like it is among them, there are also: full lock to either side and straight ahead at the lowest speed of the
laps (at most 1.3 m/s), and 10 degrees to either side at their median speed.
"""
METADATA, PICTURE = "model_metadata.json", "actions.png"
FREE = ["action_space=continuous", "action_space.speed.high=4"]
"""Overrides that limit the commands of a track's fastest lap, as for `tracks NAME --fastest`."""


class _Source(NamedTuple):
    """The source of the commands."""

    name: str
    commands: "Commands"
    car: "CarConfig"
    metadata: "ModelMetadata"
    """Metadata with the sensors, network and version for the written file."""


def add_commands(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    parser = add_command(
        commands,
        "actions",
        _actions,
        help="propose an action space from driven laps",
        description="Propose a list of actions from the commands of fast laps: of a log, of a run's best policy, or of "
        "the fastest lap of a car on a track. Write it as an option of your own, as model_metadata.json and as a "
        "picture.",
        epilog=_EPILOG,
    )
    add_run(
        parser,
        "checkpoint=NAME | KEY=VALUE",
        metavar="RUN | LOGS | TRACK",
        help="a run, logs of the service, or a track",
        completer=_complete,
    )
    parser.add_argument("--count", type=_whole, default=12, metavar="N", help="actions in all (default: 12)")
    parser.add_argument(
        "--name", help="name of the option, ./conf/action_space/NAME.yaml (default: actions-SOURCE)"
    )
    parser.add_argument(
        "--track",
        metavar="NAME",
        help="one of several tracks of a log; or a name for one that it does not name",
    )
    parser.add_argument(
        *("-o", "--output"),
        metavar="DIR",
        help=f"folder for {METADATA} and {PICTURE} (default: NAME)",
    )


def _whole(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text}: accepted: a whole number")
    return int(text)


def _actions(args: argparse.Namespace) -> int:
    from deepracer_exp.aws.models.model_metadata import model_metadata_text
    from deepracer_exp.config.custom_files.imported_options import (
        check_action_space_name,
        write_action_space,
    )
    from deepracer_exp.files import atomic_write
    from deepracer_exp.reports.tables.proposed_actions import check_count, propose_actions

    sources, overrides = runs_and_overrides(args)
    if len(sources) != 1:
        raise BadInput(
            f"{' '.join(sources) or 'RUN'}: {len(sources)} given; accepted: one run, logs or a track"
        )
    check_count(args.count)
    if args.name is not None:
        check_action_space_name(args.name)
        _check_folder(args.output or args.name)

    source = _source(sources[0], overrides, args.track)
    name = args.name or _default_name(source.name)
    folder = _check_folder(args.output or name)
    check_action_space_name(name)
    proposal = propose_actions(source.commands.within(source.car), args.count, source.car)

    from deepracer_exp.reports.charts.action_charts import proposed_actions_picture

    metadata = replace(
        source.metadata, actions=proposal.actions, low=None, high=None, training_algorithm="clipped_ppo"
    )
    title = f"{len(proposal.actions)} actions from {source.name}"
    picture = proposed_actions_picture(title, proposal)
    with writing(f"--output {folder}", "a folder"):
        folder.mkdir(parents=True, exist_ok=True)
        atomic_write(folder / METADATA, model_metadata_text(metadata))
        atomic_write(folder / PICTURE, picture)
    option = write_action_space(name, proposal.actions, f"{title}: {source.commands.laps}.")

    _print(source, proposal, args.count)
    print(f"\n  option    {option}\n  metadata  {folder / METADATA}\n  picture   {folder / PICTURE}")
    print(f"\n  train with it  deepracer-exp train action_space={name}")
    return 0


def write_lap_actions(wanted: "LapActions") -> None:
    """Write the action lists that are not options yet, from the fastest lap of the car on the track.

    Raises:
        BadInput: a file cannot be written.
        RunFailed: no lap is possible.
    """
    from deepracer_exp.config.custom_files.imported_options import (
        check_action_space_name,
        write_action_space,
    )
    from deepracer_exp.config.options import options
    from deepracer_exp.reports.tables.proposed_actions import commands_of_fastest, propose_actions

    missing = {name: count for name, count in wanted.counts.items() if name not in options("action_space")}
    for name in missing:
        check_action_space_name(name)
    if not missing:
        return
    experiment, course = experiment_on([*wanted.overrides, *FREE])
    lap = search_fastest(experiment, course)
    commands = commands_of_fastest(lap, experiment.car.name, course.name).within(experiment.car)
    for name, count in missing.items():
        actions = propose_actions(commands, count, experiment.car).actions
        path = write_action_space(name, actions, f"{len(actions)} actions from {commands.laps}.")
        print_notes([f"action_space={name}: {len(actions)} actions from {commands.laps}; {path}"])


def _check_folder(output: str) -> Path:
    """Return the folder to write to."""
    folder = Path(output).expanduser()
    for name in (METADATA, PICTURE):
        if os.path.lexists(folder / name):
            raise BadInput(f"--output {output}: {folder / name} exists already; accepted: another folder")
    return folder


def _default_name(source: str) -> str:
    return f"actions-{re.sub(r'[^A-Za-z0-9_]+', '-', source).strip('-')[:60] or 'log'}"


def _complete(prefix: str, parsed_args: argparse.Namespace, **_: Any) -> list[str]:
    """Return the names of runs and of tracks."""
    from deepracer_exp.config.options import options

    return [*complete_runs(prefix, parsed_args), *options("track")]


def _source(what: str, overrides: list[str], track: str | None) -> _Source:
    from deepracer_exp.aws.worlds.catalogue import find_world
    from deepracer_exp.config.options import options
    from deepracer_exp.runs.run_files import is_run

    place = existing_logs(what)
    is_route = place is not None and place.suffix in ROUTES
    if is_route or (place is None and (what in options("track") or find_world(what) is not None)):
        return _of_track(what, is_route, overrides, track)
    stores = read_stores(overrides, ["checkpoint"])
    if place is None or is_run(place):
        return _of_run(what, stores, track)
    if stores.values:
        raise BadInput(f"checkpoint={stores.values['checkpoint']}: {what} is a log; accepted for a run")

    from deepracer_exp.aws.logs.reader import read_recording
    from deepracer_exp.aws.models.model_metadata import ModelMetadata
    from deepracer_exp.config.named import service_car
    from deepracer_exp.reports.tables.proposed_actions import commands_of_log

    recording = read_recording(place)
    commands = commands_of_log(recording, track)
    # All cars have the service's limits.
    return _Source(recording.name, commands, service_car(), recording.metadata or ModelMetadata())


def _of_track(what: str, is_route: bool, overrides: list[str], track: str | None) -> _Source:
    """Return the fastest lap of a car between its own limits, unless an action space is given."""
    if track is not None:
        raise BadInput(f"--track {track}: {what} is a track itself; accepted for a log of several tracks")

    from deepracer_exp.commands.export.aws_files import services_metadata
    from deepracer_exp.config.overrides import group_of, override_line
    from deepracer_exp.reports.tables.proposed_actions import commands_of_fastest

    free = [] if any(group_of(override) == "action_space" for override in overrides) else FREE
    named = override_line("track.file" if is_route else "track", what)
    experiment, course = experiment_on([named, *free, *overrides])
    lap = search_fastest(experiment, course)
    commands = commands_of_fastest(lap, experiment.car.name, course.name)
    return _Source(course.name, commands, experiment.car, services_metadata(experiment))


def _of_run(what: str, stores: Stores, track: str | None) -> _Source:
    if track is not None:
        raise BadInput(f"--track {track}: {what} is no log; accepted for a log of several tracks")

    run = stores.find(what).with_policy(stores.values.get("checkpoint"))

    from deepracer_exp.commands.export.aws_files import services_metadata
    from deepracer_exp.reports.pages.driven_laps import commands_of_run

    with warnings_on_stderr():
        commands = commands_of_run(run)
    experiment = run.experiment
    return _Source(experiment.name, commands, experiment.car, services_metadata(experiment))


def _print(source: _Source, proposal: "ActionProposal", count: int) -> None:
    from rich.table import Table

    console = table_console()
    console.print(f"{source.name}: {source.commands.laps}\n", soft_wrap=True)
    table = Table(box=None, pad_edge=False)
    for head in ("action", "steering, degrees", "speed, m/s", "nearest to, % of steps"):
        table.add_column(head, justify="right", no_wrap=True)
    table.add_column("")
    for number, (action, rescue, share) in enumerate(
        zip(proposal.actions, proposal.to_recover, proposal.shares, strict=True)
    ):
        cells = f"{action.steering_deg:g}", f"{action.speed_mps:.2f}", f"{100 * share:.1f}"
        table.add_row(str(number), *cells, "to recover with" * rescue)
    console.print(table)
    degrees, mps = proposal.mean_deviation
    console.print(
        f"\nthe laps' commands are {degrees:.1f} degrees and {mps:.2f} m/s from the nearest action, on average",
        soft_wrap=True,
    )
    if len(proposal.actions) < count:
        console.print(
            f"{len(proposal.actions)} of {count}: the other commands of the laps are the same once rounded",
            soft_wrap=True,
        )
