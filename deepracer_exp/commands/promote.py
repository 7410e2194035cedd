"""`deepracer-exp promote`: a checkpoint into MLflow's registry of models."""

import argparse
from pathlib import Path

_EPILOG = """\
  deepracer-exp promote RUN                                 its best checkpoint, as EXPERIMENT@champion
  deepracer-exp promote best:default --alias rain           the best run's of an experiment
  deepracer-exp promote RUN --checkpoint 120 --model season --alias champion
  deepracer-exp evaluate run=champion                       from then on; export and clone alike

RUN is a run's folder, its name or the beginning of it, MLflow's id, best:EXPERIMENT, MODEL@ALIAS or ALIAS.
"""


def register(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    promote = commands.add_parser(
        "promote",
        help="register a checkpoint under an alias",
        description="Register a checkpoint as a version of a model in MLflow and give it an alias, by which evaluate, "
        "export and clone find it. Nothing removes it from the run's folder any more.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    promote.add_argument("run", metavar="RUN", help="a run that is recorded in MLflow")
    promote.add_argument("--checkpoint", metavar="best|last|N", help="default: best, or what the alias names")
    promote.add_argument("--model", help="name of the model (default: the experiment's)")
    promote.add_argument(
        "--alias", default="champion", help="taken from the version that has it (default: champion)"
    )
    promote.add_argument("--runs-dir", default="runs", help="where the runs are (default: runs)")
    promote.add_argument("--tracking-uri", help="MLflow store of the run (default: the one in --runs-dir)")
    promote.set_defaults(command=_promote)


def _promote(args: argparse.Namespace) -> int:
    from deepracer_exp.config.compose import typed
    from deepracer_exp.config.driving import ObservationConfig
    from deepracer_exp.config.evaluation import checkpoint_name
    from deepracer_exp.errors import BadInput
    from deepracer_exp.evaluation.references import resolve
    from deepracer_exp.formats.run_files import read_config
    from deepracer_exp.tracking.registry import check_alias, check_model, promote

    check_alias("--alias", args.alias)
    if args.model is not None:
        check_model("--model", args.model)
    try:
        given = args.checkpoint and checkpoint_name(args.checkpoint)
    except ValueError as error:
        raise BadInput(f"--checkpoint {args.checkpoint}: {error}") from None
    runs_dir = Path(args.runs_dir)
    run = resolve(args.run, runs_dir, args.tracking_uri)

    from deepracer_exp.env.observation import feature_names

    observation = typed(read_config(run.path).get("observation", {}), ObservationConfig)
    registered = promote(
        run.path,
        given or run.checkpoint or "best",
        args.model or run.path.resolve().parent.name,
        args.alias,
        feature_names(observation),
        args.tracking_uri,
        runs_dir,
    )
    print(f"{registered}: version {registered.version}")
    print(f"  run         {run.path}")
    print(f"  checkpoint  {registered.checkpoint}, sha256 {registered.sha256[:12]}")
    print(f"\n  race it     deepracer-exp evaluate run={registered}")
    return 0
