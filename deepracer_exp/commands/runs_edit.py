"""`deepracer-exp runs send`, `rename`, `note`, `tag` and `delete`: changes to single runs."""

import argparse
import shlex
import sys
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from deepracer_exp.errors import BadInput, count
from deepracer_exp.runs.run_files import RUN, full_name, run_folders

from .arguments import (
    STORES,
    STORES_METAVAR,
    Stores,
    add_command,
    add_overrides,
    add_run,
    complete_runs,
    read_stores,
    runs_and_overrides,
)
from .output import store_word

if TYPE_CHECKING:
    from deepracer_exp.runs.labels import Labels


def add_edits(actions: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the commands."""
    send = add_command(
        actions,
        "send",
        _send,
        entry=None,
        help="record in MLflow what it lacks of ended runs",
        description="Record in MLflow, from the folders of ended runs, what it lacks because it did not answer or "
        "refused; without RUN, of all runs of this store in runs_dir.",
    )
    add_run(send, STORES_METAVAR, many=True)
    for name, call, what, value in (
        ("rename", _rename, "name a run; commands find it by this name, too", "NAME"),
        ("note", _note, "write a note to a run", "TEXT"),
        ("tag", _tag, "set tags of a run; KEY= removes one", "KEY=VALUE"),
    ):
        parser = add_command(
            actions,
            name,
            call,
            entry=None,
            help=what,
            description=f"{what[0].upper()}{what[1:]}. This is kept in the run's folder and in MLflow. "
            "A run whose folder is elsewhere is given by MLflow's id.",
        )
        run = parser.add_argument("run", metavar="RUN", help=RUN)
        run.completer = complete_runs  # type: ignore[attr-defined]
        parser.add_argument("values", nargs="+" if name == "tag" else 1, metavar=value)
        if name != "tag":
            add_overrides(parser, STORES_METAVAR)
    delete = add_command(
        actions,
        "delete",
        _delete,
        entry=None,
        help="delete runs and mark them as deleted in MLflow",
        description="Delete the folders of runs in runs_dir, and mark the runs as deleted in MLflow, after a question. "
        "Runs in progress stay, and so do those that a clone or a registered model needs.",
    )
    add_run(delete, STORES_METAVAR, many=True)
    delete.add_argument("--yes", action="store_true", help="do not ask")


def _send(args: argparse.Namespace) -> int:
    from deepracer_exp.tracking.delivery import deliver, is_delivered, undelivered
    from deepracer_exp.tracking.store import resolve_store
    from deepracer_exp.tracking.tracking_file import read_tracked_run

    runs, overrides = runs_and_overrides(args)
    stores = read_stores(overrides)
    store = resolve_store(stores.uri, stores.runs_dir)
    named = [stores.find(run).path for run in runs]
    for folder in named:
        recorded = read_tracked_run(folder).store
        # What a run names as its store may be a stranger's, who would be given this user's password.
        if stores.uri is None and not store.is_named(recorded):
            raise BadInput(f"{folder}: was recorded in {recorded}; give tracking.uri={recorded}")
    folders = named
    if not named:
        everything = undelivered(run_folders(stores.runs_dir)).items()
        folders = [folder for folder, recorded in everything if store.is_named(recorded)]
    code = 0
    for folder in dict.fromkeys(folders):
        if is_delivered(folder, stores.uri, stores.runs_dir):
            print(f"{full_name(folder)}: MLflow has everything")
            continue
        try:
            points = deliver(folder, stores.uri, stores.runs_dir)
        except BadInput as error:  # of this run, such as one that was deleted in MLflow
            print(f"deepracer-exp: {error}", file=sys.stderr)
            code = 2
            continue
        print(f"{full_name(folder)}: sent, with {count(points, 'metric point')} that MLflow lacked")
    if not folders:
        print(f"MLflow ({store.shown}) has everything of the ended runs in {stores.runs_dir}")
    return code


@dataclass(frozen=True)
class _Target:
    """A run that is labelled: its folder, its run in MLflow, or both."""

    folder: Path | None
    run_id: str | None
    stores: Stores

    def labels(self) -> "Labels":
        from deepracer_exp.runs.labels import Labels, read_labels
        from deepracer_exp.tracking.delivery import recorded_labels

        if self.folder is not None:
            return read_labels(self.folder)
        return (
            recorded_labels(self.run_id, self.stores.uri, self.stores.runs_dir) if self.run_id else Labels()
        )

    def write(self, labels: "Labels") -> None:
        """Write labels into the folder and into MLflow; warn if MLflow lacks them."""
        from deepracer_exp.runs.labels import write_labels
        from deepracer_exp.runs.next_steps import own_word
        from deepracer_exp.tracking.delivery import deliver_labels
        from deepracer_exp.tracking.store import has_store, resolve_store
        from deepracer_exp.tracking.tracking_file import note_problem, read_tracked_run

        if self.folder is not None:
            write_labels(self.folder, labels)
        store = resolve_store(self.stores.uri, self.stores.runs_dir)
        if self.run_id is None or not has_store(self.stores.uri, self.stores.runs_dir):
            return
        if self.folder is not None and not store.is_named(read_tracked_run(self.folder).store):
            return  # a store that was not asked for
        try:
            deliver_labels(self.run_id, labels, self.stores.uri, self.stores.runs_dir)
        except BadInput as error:
            if self.folder is None:
                raise
            note_problem(self.folder, str(error))
            word = shlex.quote(own_word(self.folder)) + store_word(self.stores.runs_dir, self.stores.uri)
            print(f"warning: {error}\n  send it later: deepracer-exp runs send {word}", file=sys.stderr)


def _target(name: str, stores: Stores) -> _Target:
    from deepracer_exp.runs.run_files import read_run_id
    from deepracer_exp.tracking.store import is_run_id

    try:
        folder = stores.find(name).path
    except BadInput:
        if not is_run_id(name):
            raise
        return _Target(None, name, stores)  # its folder is on another machine
    return _Target(folder, read_run_id(folder), stores)


def _rename(args: argparse.Namespace) -> int:
    from deepracer_exp.config.experiment import safe_name

    target = _target(args.run, read_stores(args.overrides))
    (name,) = args.values
    try:
        safe_name(name)
    except ValueError as error:
        raise BadInput(f"{name}: {error}") from None
    others = [folder for folder in run_folders(target.stores.runs_dir) if folder != target.folder]
    from deepracer_exp.runs.labels import named_folders

    if any(folder.name == name for folder in others) or named_folders(others, name):
        raise BadInput(f"{name}: another run in {target.stores.runs_dir} has this name")
    target.write(replace(target.labels(), name=name))
    return 0


def _note(args: argparse.Namespace) -> int:
    from deepracer_exp.runs.labels import check_label

    target = _target(args.run, read_stores(args.overrides))
    (note,) = args.values
    target.write(replace(target.labels(), note=check_label("TEXT", note) or None))
    return 0


def _tag(args: argparse.Namespace) -> int:
    from deepracer_exp.runs.labels import check_tag

    words = [word for word in args.values if word.partition("=")[0] not in STORES]
    stores = read_stores(word for word in args.values if word not in words)
    changes = dict(check_tag(word) for word in words)
    if not changes:
        raise BadInput("KEY=VALUE: missing; write deepracer-exp runs tag RUN KEY=VALUE")
    target = _target(args.run, stores)
    labels = target.labels()
    tags = {key: value for key, value in (labels.tags | changes).items() if value}
    target.write(replace(labels, tags=tags))
    return 0


def _delete(args: argparse.Namespace) -> int:
    from rich.filesize import decimal

    from deepracer_exp.runs.clean import deletable, remove, total_bytes
    from deepracer_exp.runs.run_files import read_run_id
    from deepracer_exp.tracking.delivery import marked_deleted

    runs, overrides = runs_and_overrides(args)
    stores = read_stores(overrides)
    if not runs:
        raise BadInput("RUN: missing; write deepracer-exp runs delete RUN")
    folders = dict.fromkeys(stores.find(run).path for run in runs)
    items = [deletable(folder, stores.runs_dir) for folder in folders]
    for item in items:
        print(f"{decimal(item.size):>10}  {item.run}")
    if not args.yes:
        if not sys.stdin.isatty():
            raise BadInput(
                f"{count(len(items), 'run')}: nothing was deleted; give --yes to delete without a question"
            )
        print(f"delete {count(len(items), 'run')}, {decimal(total_bytes(items))}? [y/N] ", end="", flush=True)
        if sys.stdin.readline().strip().lower() not in ("y", "yes"):
            print("nothing was deleted")
            return 0
    for item in items:
        run_id = read_run_id(item.run)
        mark: AbstractContextManager[None] = nullcontext()
        if run_id is not None:
            mark = marked_deleted(item.run, run_id, stores.uri, stores.runs_dir)
        with mark:
            if not remove(item):
                raise BadInput(f"{item.run}: a training or a clone has started meanwhile; it was not deleted")
    print(f"deleted {count(len(items), 'run')}")
    return 0
