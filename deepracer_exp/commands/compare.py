"""`deepracer-exp compare`: runs, groups of runs over seeds, and logs of the service, beside each other."""

import argparse
from pathlib import Path

from deepracer_exp.errors import BadInput, count
from deepracer_exp.runs.files import CONFIG, is_run

from .arguments import STORES, Stores, add_command, add_run, read_stores, runs_and_overrides
from .compare_logs import CHECKPOINT, against_log, compare_recordings
from .compare_runs import compare_runs
from .output import check_file
from .pages import Item, add_page, add_replay, existing_logs, run_or_logs

_EPILOG = """\
  deepracer-exp compare RUN RUN                             how two runs differ, and what each achieved
  deepracer-exp compare season                              all runs of an experiment or study: those that differ only
                                                            in their seed and track are a group
  deepracer-exp compare before after                        two experiments
  deepracer-exp compare old=RUN,RUN,RUN new=RUN,RUN,RUN     groups of your own
  deepracer-exp compare RUN ~/Downloads/evaluation.tar.gz   our laps beside those of the service's evaluation
  deepracer-exp compare RUN logs/ logs2/ --open             how runs and logs learned; open the page
  deepracer-exp compare RUN RUN --replay laps.html          their fastest laps, driven beside each other
  deepracer-exp compare season --format csv > curves.csv    the learning curves over seeds

Compared are the evaluated policies of the best checkpoints: their lap, completion and race score, and their learning
curves, as interquartile means over seeds with 95% bootstrap intervals. A difference that seeds explain is called that;
it takes at least four runs of each group on a track to show one.

LOGS is a folder, an archive or a file of any layout, as `deepracer-exp analyze` takes. With one run and one log the
policy races on the log's track, in its direction, from the same starts, as many laps in a row.
"""


def add_commands(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    parser = add_command(
        commands,
        "compare",
        _compare,
        help="compare runs, groups of runs over seeds, and logs",
        description="Compare runs, groups of runs over seeds and logs of the service, print how they differ, and "
        "write a page of tables and figures.",
        epilog=_EPILOG,
        entry="evaluate",
    )
    add_run(
        parser,
        f"GROUP=RUN,RUN,... | checkpoint=NAME | {' | '.join(f'{key}=...' for key in STORES)}",
        many=True,
    )
    parser.usage = (
        "%(prog)s [-h] [--open] [--track NAME | ROUTE] [-o FILE] [--replay PAGE.html] [--format FORMAT] "
        "RUN | LOGS | EXPERIMENT | STUDY | GROUP=RUN,RUN,... [KEY=VALUE ...]"
    )
    add_page(parser, "NAME-comparison.html")
    add_replay(parser, "the fastest lap of each of two runs or logs")
    parser.add_argument(
        "--format",
        choices=("table", "json", "csv"),
        default="table",
        help="of the output: json has groups, differences and learning curves, csv the curves",
    )


def _compare(args: argparse.Namespace) -> int:
    from deepracer_exp.config.own_class import allow_given

    given, overrides = runs_and_overrides(args)
    keys = (*STORES, CHECKPOINT)
    own = [word for word in overrides if word.partition("=")[0] in keys or "." in word.partition("=")[0]]
    stores = read_stores(allow_given(own), [CHECKPOINT])
    check_file("--output", args.output)
    check_file("--replay", args.replay, ".html")
    items = [_item(word, None, stores) for word in given]
    for word in overrides:
        if word not in own:
            name, _, members = word.partition("=")
            items += [_item(member, name, stores) for member in members.split(",")]
    logs = [item for item in items if item.is_logs]
    runs = list(dict.fromkeys(path.resolve() for item in items if not item.is_logs for path in item.paths))
    if len(runs) + len(logs) < 2:
        raise BadInput(
            f"{' '.join([*given, *(word for word in overrides if word not in own)]) or 'RUN RUN'}: "
            f"{count(len(runs), 'run')} and {count(len(logs), 'log')}; accepted: two or more that differ, or an "
            "experiment or a study with several runs"
        )
    if args.replay is not None and len(runs) + len(logs) > 2:
        raise BadInput(f"--replay {args.replay}: {len(runs) + len(logs)} runs and logs given; accepted: two")
    if logs and args.format != "table":
        raise BadInput(f"--format {args.format}: accepted with runs only; {logs[0].word} is a log")
    one_of_each = len(runs) == len(logs) == 1
    if CHECKPOINT in stores.values and not one_of_each:
        raise BadInput(f"checkpoint={stores.values[CHECKPOINT]}: accepted with one run and one log")
    if one_of_each:
        (name,) = [item.word for item in items if not item.is_logs]
        return against_log(args, name, logs[0].paths[0], stores)
    return compare_recordings(args, items) if logs else compare_runs(args, items)


def _item(word: str, group: str | None, stores: Stores) -> Item:
    """Find what a word means: a run, an experiment or study, or logs.

    Raises:
        BadInput: it is none of them, or an experiment without a run.
    """
    path = existing_logs(word)
    if path is not None and is_run(path):
        return Item(word, group, (path,))
    folders = [path] if path is not None else []
    if Path(word).name == word:
        folders.append(stores.runs_dir / word)
    for folder in folders:
        if members := sorted(file.parent for file in folder.glob(f"[!.]*/{CONFIG}")):
            return Item(word, group, tuple(members), True)
    return Item(word, group, (run_or_logs(word, stores),))
