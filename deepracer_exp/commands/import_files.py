"""`deepracer-exp import`: options made of a DeepRacer model's files."""

import argparse

from .output import print_notes


def add_import(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    parser = commands.add_parser(
        "import",
        help="turn a DeepRacer model's files into options",
        description=(
            "Turn reward_function.py, model_metadata.json and hyperparameters.json, whichever of them are there, into "
            "options: files in ./conf, to train with and to edit. Every command offers the options in ./conf of the "
            "current folder beside the project's own. To train with such files once: deepracer-exp train "
            "custom_files=DIR."
        ),
    )
    parser.add_argument(
        "folder", metavar="DIR", help="deepracer-for-cloud's custom_files, or a model's folder"
    )
    parser.add_argument(
        "--name", required=True, help="name of the options, as in: deepracer-exp train experiment=NAME"
    )
    parser.set_defaults(command=_import)


def _import(args: argparse.Namespace) -> int:
    from deepracer_exp.config.compose import compose_experiment
    from deepracer_exp.config.custom_files import KEY, import_files, read_custom_files
    from deepracer_exp.config.overrides import override_line
    from deepracer_exp.rewards.source import load_reward_source

    files = read_custom_files(args.folder)
    experiment, composition = compose_experiment([override_line(KEY, args.folder)])
    load_reward_source(experiment.reward)
    written = import_files(files, args.name, composition.mapping)
    print_notes(composition.notes)
    for path in written:
        print(path)
    print(f"\n  train it  deepracer-exp train experiment={args.name}")
    return 0
