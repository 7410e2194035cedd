"""A model of the service becomes a run like any other, and a damaged one becomes nothing."""

import contextlib
import gzip
import io
import json
import random
import tarfile
import zipfile

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from deepracer_exp.agents.actor_critic import INITIAL_STD, build_actor_critic
from deepracer_exp.agents.service_weights import POLICY, VALUE, policy_of_sac, to_service
from deepracer_exp.aws.models.archive import read_model
from deepracer_exp.aws.models.graph_def import policy_graph
from deepracer_exp.aws.models.tf_checkpoint import write_checkpoint
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.action_space import build_action_space
from deepracer_exp.env.observation import observation_shape
from deepracer_exp.errors import BadInput
from deepracer_exp.runs.checkpoints import networks_of, read_checkpoint
from deepracer_exp.runs.stored_run import StoredRun
from tests.conftest import IN_PROCESS
from tests.memory import traced

NAME = "11_Step-38428.ckpt"
INDEX, DATA = f"model/{NAME}.index", f"model/{NAME}.data-00000-of-00001"
SENSORS = ("FRONT_FACING_CAMERA",)
METADATA = {
    "action_space": [{"steering_angle": angle, "speed": 1.5} for angle in (-30, -15, 0, 15, 30)],
    "sensor": list(SENSORS),
    "neural_network": "DEEP_CONVOLUTIONAL_NETWORK_DEEP",  # the smallest file
    "version": "4",
}
# Running it leaves a file.
REWARD = "open('it_was_run', 'w')\n\n\ndef reward_function(params):\n    return 1.0\n"
SMALL = {
    "reward_function.py": REWARD.encode(),
    "model_metadata.json": json.dumps(METADATA).encode(),
    "ip/hyperparameters.json": b'{"lr": 0.0002, "batch_size": 32}',
    "training_params.yaml": b"WORLD_NAME: Oval_track\n",
    "training-simtrace/0-iteration.csv": b"episode,steps\n",
}


@pytest.fixture(scope="module")
def networks():
    experiment, _ = compose_experiment(["observation=camera", "network=deep"])
    shape = observation_shape(experiment.observation)
    return build_actor_critic(experiment.network, shape, 5, torch.Generator().manual_seed(1))


@pytest.fixture(scope="module")
def weights(networks):
    return to_service(networks, SENSORS)


def files_of(tensors):
    index, data = write_checkpoint(tensors)
    return {INDEX: index, DATA: data} | SMALL


def write_folder(folder, files):
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder


def tar_of(files, *members):
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w:gz", compresslevel=1) as archive:
        for member in members:
            archive.addfile(member)
        for name, content in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))
    return packed.getvalue()


def zip_of(files):
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return packed.getvalue()


def test_a_model_becomes_a_run_and_nothing_of_it_is_run(
    call, run_at, tmp_path, monkeypatch, networks, weights
):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "account"))
    write_folder(tmp_path / "sent", files_of(weights))
    ended = call("import", "sent", "--name", "mine", "tracking=off", "seed=3")
    assert ended.code == 0, ended.stderr
    assert not list(tmp_path.rglob("it_was_run"))
    place = f"runs/{ended.folder.parent.name}/{ended.folder.name}"
    assert f"deepracer-exp clone {place} reward.file=conf/reward/mine.py" in ended.stdout
    assert "deepracer-exp analyze sent" in ended.stdout
    run = StoredRun(ended.folder)
    experiment = run.experiment
    assert (experiment.name, experiment.seed, list(experiment.tracks)) == ("mine", 3, ["Oval_track"])
    assert experiment.observation.camera.shape == (1, 120, 160)
    assert (experiment.algorithm.lr, experiment.algorithm.batch_size) == (2e-4, 32)
    assert build_action_space(experiment.action_space).n == 5
    for checkpoint in ("best", "last"):
        found = read_checkpoint(experiment, run.checkpoints, checkpoint).networks.state_dict()
        assert all(torch.equal(value, found[name]) for name, value in networks.state_dict().items())
    assert ended.summary["reason"] == f"imported from sent/{INDEX}"
    assert (tmp_path / "conf/reward/mine.py").read_text() == REWARD
    call("import", "sent", "--name", "mine", "tracking=off").assert_refused("exists already")
    assert len(list(tmp_path.glob("runs/mine/*"))) == 1
    # An import does not use the reward function: in a later command it is still a stranger's.
    run_at(tmp_path, "clone", str(ended.folder)).assert_refused(
        "not a reward function that you have trained with"
    )
    assert not list(tmp_path.rglob("it_was_run"))


SAC_METADATA = METADATA | {
    "action_space": {"steering_angle": {"low": -30, "high": 30}, "speed": {"low": 0.5, "high": 1.5}},
    "action_space_type": "continuous",
    "training_algorithm": "sac",
}
SAC_FILES = {
    "model_metadata.json": json.dumps(SAC_METADATA).encode(),
    "ip/hyperparameters.json": b'{"lr": 0.0002, "batch_size": 32, "sac_alpha": 0.4}',
}
SAC_HEAD = "main_level/agent/policy/online/network_0/sac_policy_head_0"


def services_sac(networks):
    """Return tensors as a checkpoint of the service's SAC has them, its critics and counters among them."""
    tensors = {}
    for name, value in to_service(networks, SENSORS).items():
        name = name.replace(POLICY, "main_level/agent/policy/online/network_0")
        name = name.replace("middleware_fc_embedder/Dense_4", "sac_policy_head_0/dense")
        tensors[name.replace("ppo_head_0", "sac_policy_head_0")] = value
    last = networks.policy_head[0].module.layers.perceptron[-1]
    tensors[f"{SAC_HEAD}/dense_1/kernel"] = last.weight.detach().numpy().T[:, 2:].copy()
    tensors[f"{SAC_HEAD}/dense_1/bias"] = last.bias.detach().numpy()[2:].copy()
    tensors[f"{SAC_HEAD}/dense/kernel/Adam"] = np.zeros((3, 3), np.float32)
    tensors["main_level/agent/q/online/network_0/sac_q_head_0/dense/kernel"] = np.zeros((8, 4), np.float32)
    tensors["main_level/agent/v/target/network_0/gradients_from_head_0-0_rescalers"] = np.ones((), np.float32)
    return tensors


@pytest.fixture(scope="module")
def soft():
    lines = ["observation=camera", "network=deep", "network.hidden=[256,128,256]", "algorithm=sac"]
    experiment, _ = compose_experiment(lines)
    return networks_of(experiment, torch.Generator().manual_seed(1))


def test_a_model_of_sac_becomes_a_run_of_sac_with_its_policy(call, tmp_path, soft):
    write_folder(tmp_path / "sent", files_of(services_sac(soft)) | SAC_FILES)
    ended = call("import", "sent", "--name", "mine", "tracking=off")
    assert ended.code == 0, ended.stderr
    said = " ".join(ended.stderr.split())
    assert "fresh, and a clone" in said
    assert "algorithm.learn_alpha=false" in said
    run = StoredRun(ended.folder)
    algorithm = run.experiment.algorithm
    assert (algorithm.alpha, algorithm.batch_size) == (0.4, 32)
    found = read_checkpoint(run.experiment, run.checkpoints, "best").networks
    for name, value in soft.policy_head.state_dict().items():
        assert torch.equal(value, found.policy_head.state_dict()[name])
    refused = call("import", "sent", "--name", "other", "tracking=off", "algorithm=ppo")
    refused.assert_refused("the weights are of SAC")


def test_a_frozen_policy_of_sac_has_fresh_deviations_and_another_head_is_named(soft):
    tensors = {name: value for name, value in services_sac(soft).items() if "dense_1" not in name}
    policy = policy_of_sac(tensors, "model.pb")
    head = policy[f"{POLICY}/ppo_head_0/policy_mean/bias"]
    np.testing.assert_allclose(np.exp(head[2:]), INITIAL_STD, rtol=1e-6)
    assert (policy[f"{POLICY}/ppo_head_0/policy_mean/kernel"][:, 2:] == 0).all()
    with pytest.raises(BadInput, match="has the layers"):
        policy_of_sac({name: value for name, value in tensors.items() if "/dense/" not in name}, "model.pb")
    with pytest.raises(BadInput, match="no sac_policy_head_0/policy_mean"):
        policy_of_sac(to_service(soft, SENSORS), "model.pb")


def test_a_model_of_several_tracks_is_a_run_on_the_first_unless_others_are_given(call, tmp_path, weights):
    settings = b"WORLD_NAME: [Oval_track, Bowtie_track]\nREVERSE_DIR: ['True', 'False']\n"
    files = files_of(weights) | {"training_params.yaml": settings}
    write_folder(tmp_path / "sent", files)
    ended = call("import", "sent", "--name", "mine", "tracking=off")
    assert ended.code == 0, ended.stderr
    tracks = StoredRun(ended.folder).experiment.tracks
    assert {name: track.direction for name, track in tracks.items()} == {"Oval_track": "reversed"}
    more = "training_params.yaml: further workers: not applied: track=[A,B] trains on several tracks"
    assert more in ended.stderr
    both = "track=[Oval_track,Bowtie_track]"
    again = call("import", "sent", "--name", "other", "tracking=off", both)
    assert again.code == 0, again.stderr
    (folder,) = (tmp_path / "runs" / "other").iterdir()
    assert list(StoredRun(folder).experiment.tracks) == ["Oval_track", "Bowtie_track"]


@pytest.mark.parametrize("pack", [tar_of, zip_of, None], ids=["tar.gz", "zip", "folder"])
def test_an_archive_holds_what_the_folder_does(tmp_path, pack):
    tensors = {"a/kernel": np.arange(6, dtype=np.float32).reshape(2, 3), "b/bias": np.ones(4, np.float32)}
    files = {f"prefix/{name}": content for name, content in files_of(tensors).items()}
    # What a Mac adds to its archives.
    files |= {f"__MACOSX/prefix/{name}": b"Mac OS X" for name in (INDEX, DATA)}
    files |= {f"prefix/{name.replace('model/', 'model/._')}": b"Mac OS X" for name in (INDEX, DATA)}
    if pack is None:
        path = write_folder(tmp_path / "model", files)
    else:
        path = tmp_path / "model.archive"
        path.write_bytes(pack(files))
    model = read_model(str(path), "best")
    assert {name: value.tolist() for name, value in model.tensors.items()} == {
        name: value.tolist() for name, value in tensors.items()
    }
    assert model.source.endswith(f"/{NAME}.index")
    assert model.has_logs
    assert model.files["hyperparameters.json"] == SMALL["ip/hyperparameters.json"]


ELSE = "the best checkpoint, 7_Step-70.ckpt, is not among the files: 9_Step-90.ckpt is used"


@pytest.mark.parametrize(
    ("asked", "there", "chosen", "notes"),
    [("best", (3, 7, 9), 7, ()), ("last", (3, 7, 9), 9, ()), ("best", (3, 9), 9, (ELSE,))],
)
def test_the_best_checkpoint_is_taken_unless_the_last_is_asked_for(tmp_path, asked, there, chosen, notes):
    files = {}
    for number in there:
        index, data = write_checkpoint({"a/bias": np.full(1, number, np.float32)})
        stem = f"model/{number}_Step-{10 * number}.ckpt"
        files |= {f"{stem}.index": index, f"{stem}.data-00000-of-00001": data}
    names = {"best_checkpoint": {"name": "7_Step-70.ckpt"}, "last_checkpoint": {"name": "9_Step-90.ckpt"}}
    files["model/deepracer_checkpoints.json"] = json.dumps(names).encode()
    model = read_model(str(write_folder(tmp_path / "model", files)), asked)
    assert model.tensors["a/bias"].item() == chosen
    assert model.notes == notes


def _header(name, kind=tarfile.REGTYPE, size=0):
    member = tarfile.TarInfo(name)
    member.type = kind
    packed = member.tobuf()
    if size:
        member.size = size
        packed = member.tobuf(tarfile.GNU_FORMAT)
    return packed


def with_bit_flipped(content, chance, until):
    raw = bytearray(content)
    raw[chance.randrange(until)] ^= 1 << chance.randrange(8)
    return bytes(raw)


# Of weights that do not fit there is one kind here; the tests of agents.service_weights have the others.
KINDS = (
    *("truncated archive", "truncated data", "a flipped bit", "a flipped bit in the index", "a link"),
    *("a path that leads out", "a promise of terabytes", "a name of gigabytes", "a bomb"),
    *("a foreign tensor", "other metadata", "other files"),
)


def damaged(kind, seed, weights):
    """Return an archive with one fault."""
    chance = random.Random(seed)
    files = files_of(weights)
    if kind == "truncated archive":
        whole = tar_of(files)
        return whole[: int(len(whole) * chance.uniform(0.01, 0.9))]
    if kind == "truncated data":
        files[DATA] = files[DATA][: chance.randrange(len(files[DATA]))]
    elif kind == "a flipped bit":
        files[DATA] = with_bit_flipped(files[DATA], chance, len(files[DATA]))
    elif kind == "a flipped bit in the index":
        files[INDEX] = with_bit_flipped(files[INDEX], chance, len(files[INDEX]) - 48)
    elif kind == "a link":
        member = tarfile.TarInfo(chance.choice([DATA, "model/other", "reward_function.py"]))
        member.type, member.linkname = chance.choice([tarfile.SYMTYPE, tarfile.LNKTYPE]), "/etc/passwd"
        return tar_of(files, member)
    elif kind == "a path that leads out":
        files[chance.choice(["/tmp/x", "../x", "model/../../x", "..\\x", "C:\\x"])] = b"x"
        return chance.choice([tar_of, zip_of])(files)
    elif kind == "a promise of terabytes":
        return gzip.compress(_header("model/big", size=chance.randrange(2**33, 2**40)))
    elif kind == "a name of gigabytes":
        return gzip.compress(_header("x", chance.choice([b"x", b"L", b"g"]), size=2**31) + bytes(2**20))
    elif kind == "a bomb":
        files["model_metadata.json"] = bytes(2**26)
        return chance.choice([tar_of, zip_of])(files)
    elif kind == "a foreign tensor":
        name = chance.choice([one for one in weights if "rescalers" not in one])
        files |= files_of(weights | {f"{name}_of_others": np.zeros(chance.randrange(1, 9), np.float32)})
    elif kind == "other metadata":
        changes = {"sensor": ["STEREO_CAMERAS"]}, {"action_space": METADATA["action_space"][:4]}
        sac = {"training_algorithm": "sac"}
        others = [json.dumps(METADATA | change).encode() for change in (*changes, sac)]
        files["model_metadata.json"] = chance.choice([b"{", b"[]", b"\xff\xfe", *others])
    else:
        del files[chance.choice([DATA, INDEX, "model_metadata.json"])]
    return tar_of(files)


def assert_nothing_is_made_of(content, call, tmp_path):
    (tmp_path / "model.tar.gz").write_bytes(content)
    ended = call("import", "model.tar.gz", "--name", "mine", "tracking=off")
    ended.assert_refused("model")
    assert "/tmp/tmp" not in ended.complaint
    assert [path.name for path in tmp_path.iterdir()] == ["model.tar.gz"]


@pytest.fixture(scope="module")
def light(weights):
    """Weights that are packed in no time."""
    return {name: np.zeros_like(value) for name, value in weights.items()}


@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_archive_is_refused_in_one_line_and_leaves_nothing(call, tmp_path, light, kind):
    assert_nothing_is_made_of(damaged(kind, 0, light), call, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_two_hundred_damaged_archives_are_refused_within_bounded_memory(call, tmp_path, light, kind):
    packed = sum(value.nbytes for value in light.values())
    for seed in range(KINDS.index(kind), 200, len(KINDS)):
        assert_nothing_is_made_of(damaged(kind, seed, light), call, tmp_path)
        with traced() as peak:
            with contextlib.suppress(BadInput):
                read_model(str(tmp_path / "model.tar.gz"), "best")
            assert peak() < packed + 2**26


def actions(networks, frames):
    for module in networks.modules():
        if hasattr(module, "half_precision"):
            module.half_precision = False
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        return torch.cat(
            [networks.policy(TensorDict({"pixels": part}, [len(part)]))["action"] for part in frames]
        )


@pytest.mark.slow
@pytest.mark.parametrize("space", ["discrete", "continuous"])
def test_a_policy_that_goes_there_and_back_acts_the_same(call, space):
    trained = call(
        *("train", *IN_PROCESS, "observation=camera", "network=deep", "name=here", "track=Oval_track"),
        *(f"action_space={space}", "budget.env_steps=256", "collector.cars=4"),
        *("algorithm.frames_per_iteration=128", "algorithm.batch_size=64"),
    )
    assert trained.code == 0, trained.stderr
    here = trained.folder
    assert call("export", str(here), "format=aws-model", "checkpoint=last", "-o", "sent").code == 0
    back = call("import", "sent", "--name", "there", "tracking=off")
    assert back.code == 0, back.stderr
    (there,) = trained.cwd.glob("runs/there/*")
    policies = [
        read_checkpoint(StoredRun(folder).experiment, folder / "checkpoints", "last").networks
        for folder in (here, there)
    ]
    torch.manual_seed(0)
    frames = [torch.randint(0, 256, (100, 1, 120, 160), dtype=torch.uint8) for _ in range(10)]
    assert torch.equal(actions(policies[0], frames), actions(policies[1], frames))
    assert call("export", str(there), "format=aws-model", "-o", "again").code == 0
    for ending in ("index", "data-00000-of-00001"):
        (sent,), (again,) = (
            list((trained.cwd / name).glob(f"model/*.{ending}")) for name in ("sent", "again")
        )
        assert sent.read_bytes() == again.read_bytes()
    raced = call("evaluate", str(there), "evaluation=three_trials")
    assert raced.code == 0, raced.stderr
    small = ("collector=in_process", "collector.cars=4", "stopping=none", "report=false", "tracking=off")
    cloned = call(
        *("clone", str(there), "budget.env_steps=64", "algorithm.frames_per_iteration=64", *small),
        *(
            "algorithm.episodes_per_iteration=null",
            "algorithm.batch_size=64",
            "algorithm.epochs=1",
            "name=further",
        ),
    )
    assert cloned.code == 0, cloned.stderr
    (further,) = trained.cwd.glob("runs/further/*")
    rates = [StoredRun(folder).experiment.algorithm.lr for folder in (there, further)]
    assert rates[1] == pytest.approx(rates[0] / 10)
    begun, then = (folder / "checkpoints" for folder in (there, further))
    before = read_checkpoint(StoredRun(there).experiment, begun, "last").networks.state_dict()
    after = read_checkpoint(StoredRun(further).experiment, then, "last").networks.state_dict()
    moved = [(after[name] - before[name]).abs().max().item() for name in before]
    assert 0 < max(moved) < 0.01, "both trunks begin where the parent's are"


def test_of_a_frozen_graph_the_value_network_starts_fresh(call, tmp_path, weights, networks):
    policy = {name: value for name, value in weights.items() if name.startswith(POLICY)}
    graph = policy_graph(policy, {SENSORS[0]: (120, 160, 1)}, (4, 2, 2, 1))
    metadata = {"model_metadata.json": SMALL["model_metadata.json"]}
    write_folder(tmp_path / "car", {"agent/model.pb": graph} | metadata)
    ended = call("import", "car", "--name", "mine", "tracking=off")
    assert ended.code == 0, ended.stderr
    assert "the value network starts fresh" in ended.stderr
    run = StoredRun(ended.folder)
    found = to_service(read_checkpoint(run.experiment, run.checkpoints, "best").networks, SENSORS)
    assert all(np.array_equal(found[name], value) for name, value in policy.items())
    fresh = f"{VALUE}/middleware_fc_embedder/Dense_0/kernel"
    assert not np.array_equal(found[fresh], weights[fresh])
