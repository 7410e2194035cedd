"""`deepracer-exp validate`, `import` and `export`: rewards and models as files."""

import argparse
import os
import re
import shlex
from dataclasses import replace
from pathlib import Path

from deepracer_exp.collectors.forking import start_workers_early
from deepracer_exp.errors import BadInput

from .arguments import add_command, add_overrides, add_run, read_stores, run_and_overrides
from .output import plain_console, print_notes, warnings_on_stderr


def add_commands(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the commands."""
    parser = add_command(
        commands,
        "validate",
        _validate,
        help="find out what a reward function rewards",
        description=(
            "Check a reward function as deepracer-on-aws does, call it in many situations on the track, draw its "
            "rewards, and warn of common mistakes."
        ),
        epilog=_VALIDATE_EPILOG,
    )
    add_overrides(parser, "reward=NAME | reward.file=PATH | KEY=VALUE")
    parser.add_argument(
        *("-o", "--output"),
        type=picture_file,
        help="picture to write (default: runs/validate/REWARD-TRACK.png)",
    )
    parser.add_argument("--strict", action="store_true", help="refuse what deepracer-on-aws would refuse")

    parser = add_command(
        commands,
        "import",
        _import,
        help="turn a DeepRacer model into a run, or its files into options",
        description=(
            "Turn reward_function.py, model_metadata.json and hyperparameters.json, whichever of them are there, into "
            "options: files in ./conf, to train with and to edit. Every command offers the options in ./conf of the "
            "current folder beside the project's own. To train with such files once: deepracer-exp train "
            "custom_files=DIR. Where the path holds a trained model of the AWS console, deepracer-for-cloud or "
            "deepracer-on-aws, with the weights of its policy, it becomes a run as well."
        ),
        epilog=_IMPORT_EPILOG,
    )
    parser.add_argument(
        "path", metavar="PATH", help="deepracer-for-cloud's custom_files, a model's folder or its archive"
    )
    add_overrides(parser)
    parser.add_argument(
        "--name", required=True, help="name of the options, as in: deepracer-exp train experiment=NAME"
    )

    parser = add_command(
        commands,
        "export",
        _export,
        help="write a trained policy or its training files for other programs",
        description="Write a run's policy as ONNX or for a physical car, or the files that AWS's console and "
        "deepracer-for-cloud train from.",
        epilog=_EXPORT_EPILOG,
        entry=None,
    )
    add_run(parser, "format=onnx|aws|aws-model|car|car-openvino | KEY=VALUE")
    parser.add_argument(
        "-o", "--output", help="file or folder to write (default: in the run's folder, export/)"
    )


def picture_file(output: str) -> str:
    """Return the file of a picture: without an ending, matplotlib appends this one."""
    return output if Path(output).suffix else f"{output}.png"


_IMPORT_EPILOG = """\
  deepracer-exp import ~/deepracer-for-cloud/custom_files --name mine
  deepracer-exp import model.tar.gz --name mine             its best checkpoint, as a run of the experiment mine
  deepracer-exp import model.tar.gz --name mine checkpoint=last track=Oval_track
"""


def _import(args: argparse.Namespace) -> int:
    if _holds_model(args.path):
        return _import_model(args)
    if args.overrides:
        raise BadInput(f"{args.overrides[0]}: {args.path} holds no model; accepted for one: KEY=VALUE")

    from deepracer_exp.config.compose import compose_experiment
    from deepracer_exp.config.custom_files.imported_options import import_files
    from deepracer_exp.config.custom_files.model_files import KEY, read_custom_files
    from deepracer_exp.config.overrides import override_line
    from deepracer_exp.training.plan import plan_training

    files = read_custom_files(args.path)
    plan = plan_training(*compose_experiment([override_line(KEY, args.path)]))
    written = import_files(files, args.name, plan.composition.mapping)
    print_notes((*plan.composition.notes, *plan.files.remarks))
    for path in written:
        print(path)
    print(f"\n  train it  deepracer-exp train experiment={args.name}")
    return 0


def _holds_model(path: str) -> bool:
    """Return whether a path is a file, or a folder with weights in it."""
    names = (name for _, _, names in os.walk(path) for name in names)
    return Path(path).is_file() or any(name.endswith((".index", ".pb")) for name in names)


def _import_model(args: argparse.Namespace) -> int:
    import zipfile

    from deepracer_exp.runs.next_steps import own_word
    from deepracer_exp.runs.stored_run import StoredRun

    from .import_model import import_model

    imported = import_model(args.path, args.name, args.overrides)
    print_notes(imported.notes)
    for path in (*imported.options, imported.folder):
        print(path)
    run = shlex.quote(own_word(imported.folder))
    print(f"\n  race it            deepracer-exp evaluate {run}")
    if (reward := StoredRun(imported.folder).experiment.reward.file) is None:
        print(f"  train it further   deepracer-exp clone {run}")
    else:
        named = shlex.quote(f"reward.file={os.path.relpath(reward)}")
        print(f"  train it further   deepracer-exp clone {run} {named}   # once you have read this file")
    if imported.has_logs and not zipfile.is_zipfile(args.path):
        print(f"  its training       deepracer-exp analyze {shlex.quote(args.path)}")
    return 0


_FORMATS = ("onnx", "car", "car-openvino", "aws", "aws-model")
_EXPORT_EPILOG = """\
  deepracer-exp export RUN format=onnx                      the network as one file, checked against itself
  deepracer-exp export RUN format=onnx checkpoint=last -o policy.onnx
  deepracer-exp export champion format=onnx                 the checkpoint with that alias (deepracer-exp runs promote)
  deepracer-exp export RUN format=aws -o custom_files       reward_function.py, model_metadata.json and
                                                            hyperparameters.json
  deepracer-exp export RUN format=aws-model -o my_model     these and the weights: a pretrained model for
                                                            deepracer-for-cloud and deepracer-on-aws
  deepracer-exp export RUN format=car -o my_model.tar.gz    for the console of a physical car, which calls it my_model;
                                                            needs a policy that sees with the camera
  deepracer-exp export RUN format=car-openvino              and the graph as cars of Ubuntu 24.04 convert it
"""


def _export(args: argparse.Namespace) -> int:
    from deepracer_exp.config.own_class import allow_given

    name, overrides = run_and_overrides(args)
    stores = read_stores(allow_given(overrides), ["format", "checkpoint", "debug"])
    format = stores.values.get("format")
    if format is None:
        raise BadInput(
            "format",
            "missing; write format=onnx, format=aws, format=aws-model, or, for a policy that sees with the "
            "camera, format=car",
        )
    if format not in _FORMATS:
        raise BadInput(f"format={format}", "no such format", ", ".join(_FORMATS))
    run = stores.find(name)
    if format != "aws":
        run = run.with_policy(stores.values.get("checkpoint"))
    if format in ("car", "car-openvino"):
        from deepracer_exp.env.real_car import check_car

        check_car(run.experiment)

    from deepracer_exp.commands.export.export import export

    with warnings_on_stderr():
        export(run, format, args.output, plain_console())
    return 0


_VALIDATE_EPILOG = """\
  deepracer-exp validate reward=racing_line                 from the reward zoo, on the default track
  deepracer-exp validate reward.file=my_reward.py track=Oval_track
  deepracer-exp validate reward.file=my_reward.py trial=60s
                                                            also train for that long: do reward and progress rise?

exit code: 0 it can be trained, even with warnings; 2 it cannot, or with --strict deepracer-on-aws would refuse it
"""


def _validate(args: argparse.Namespace) -> int:
    # Before NumPy is imported: a reward function has one thread in a training, too, and on a busy machine the threads
    # of a small linear-algebra problem wait for one another.
    os.environ.setdefault("OMP_NUM_THREADS", "1")

    from deepracer_exp.config.compose import compose_experiment
    from deepracer_exp.training.plan import plan_training

    trials = [override for override in args.overrides if override.startswith("trial=")]
    overrides = [override for override in args.overrides if override not in trials]
    shorter = _trial_overrides(trials[-1]) if trials else []
    experiment, composition = compose_experiment(overrides)
    args.debug = experiment.debug
    print_notes(composition.notes)
    plan, trial = plan_training(experiment, composition), None
    print_notes(plan.files.remarks)
    if shorter:
        short, short_composition = compose_experiment([*overrides, *shorter])
        trial = replace(plan, experiment=short, composition=short_composition)
        start_workers_early(experiment.collector.forks)

    from deepracer_exp.commands.validation.validate import validate_reward

    return validate_reward(plan, trial, args.output, args.strict, plain_console(), plain_console(stderr=True))


def _trial_overrides(word: str) -> list[str]:
    """Return the overrides for a training of `trial=60s`, `trial=2min` or `trial=90`; its run is in `runs/validate`."""
    match = re.fullmatch(r"trial=(\d+(?:\.\d+)?)(s|min)?", word)
    seconds = float(match[1]) * (60 if match[2] == "min" else 1) if match else 0.0
    if not seconds:
        raise BadInput(
            f"{word}: not a time; accepted: seconds or minutes above 0, e.g. trial=60s, trial=2min"
        )
    return [
        *("name=validate", "tracking=off", "stopping=none", "checkpoints.every=null"),
        *("budget=default", "budget.env_steps=null", "budget.alerts=[]", f"budget.minutes={seconds / 60!r}"),
    ]
