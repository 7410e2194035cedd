import re
from dataclasses import fields

import pytest

from deepracer_exp.aws.worlds.catalogue import find_world, leaders, worlds
from deepracer_exp.config.compose import compose_experiment, expand_grid
from deepracer_exp.config.driving import TrackConfig
from deepracer_exp.config.overrides import parse_single
from deepracer_exp.config.track_options import by_world_name
from tests.conftest import refused

TWO = "track=[Oval_track,Bowtie_track]"


def tracks(*overrides: str) -> dict:
    return compose_experiment(overrides)[0].tracks


def refusal(*overrides: str) -> str:
    message = refused(compose_experiment, overrides)
    assert "several_tracks" not in message
    return message


def test_one_track_is_its_config_and_several_are_a_mapping_by_name():
    experiment, composition = compose_experiment(["track=Oval_track"])
    assert experiment.track.name == "Oval_track"
    assert experiment.tracks == {"Oval_track": experiment.track}
    several, of_several = compose_experiment([TWO])
    assert list(several.track) == list(several.tracks) == ["Oval_track", "Bowtie_track"]
    assert several.track["Oval_track"] == experiment.track
    assert of_several.mapping["track"]["Oval_track"] == composition.mapping["track"]
    assert of_several.choices["track"] == "[Oval_track,Bowtie_track]"
    assert "several_tracks" not in of_several.mapping
    assert list(of_several.mapping) == list(composition.mapping)


def test_all_are_the_first_world_of_each_family():
    assert set(tracks("track=all")) == set(leaders())
    assert list(compose_experiment(["track=[Oval_track]"])[0].track) == ["Oval_track"]


@pytest.mark.parametrize("variant", ["Oval_track", "reInvent2019_wide_mirrored", "2024_reinvent_champ_cw"])
def test_a_world_is_named_in_the_configuration_and_not_copied_into_it(variant):
    experiment, composition = compose_experiment([f"track={variant}"])
    assert (experiment.track.name, composition.choices["track"]) == (variant, variant)
    assert composition.mapping["track"]["knots"] is None
    assert composition.mapping["track"].keys() == {field.name for field in fields(TrackConfig)}


def test_every_official_name_is_understood_in_any_case():
    for title in (spelling for world in worlds().values() for spelling in (world.title, world.title.lower())):
        assert by_world_name(parse_single(f"track={title}")).value() == find_world(title)
        assert by_world_name(parse_single(f"track=[{title},Oval_track]")).value()[0] == find_world(title)


def test_an_official_name_is_a_track_of_several_and_of_a_sweep():
    assert list(tracks("track=[Ace Speedway,2022 re:Invent Championship]")) == [
        "2022_april_open",
        "2022_reinvent_champ",
    ]
    lines = expand_grid(["track=Oval_track,Ace Speedway"])
    assert [compose_experiment(line)[0].track.name for line in lines] == ["Oval_track", "2022_april_open"]


def test_a_value_reaches_the_track_it_names_alone():
    chosen = tracks(
        "track=[Oval_track,2022_summit_speedway]",
        "track.2022_summit_speedway.weight=2",
        "track.Oval_track.floor.friction=0.5",
        "track.Oval_track.file=/a,b/[c] d.npy",
    )
    assert [track.weight for track in chosen.values()] == [1, 2]
    assert [track.floor.friction for track in chosen.values()] == [0.5, 1.0]
    assert [track.file for track in chosen.values()] == ["/a,b/[c] d.npy", None]


def test_a_value_without_a_name_reaches_every_track_but_those_with_one_of_their_own():
    chosen = tracks(TWO, "track.Bowtie_track.direction=reversed", "track.direction=alternate")
    assert [track.direction for track in chosen.values()] == ["alternate", "reversed"]


def test_a_list_in_an_experiments_file_is_refused(own):
    """Hydra would lay one track over the other."""
    own("experiment/mine.yaml", "# @package _global_\ndefaults:\n  - override /track: [Oval_track, Monaco]\n")
    assert refusal("experiment=mine").startswith("track: an option file cannot choose several tracks")


def test_the_last_choice_counts():
    assert list(tracks("experiment=tiny", "track=Monaco", TWO)) == ["Oval_track", "Bowtie_track"]
    assert list(tracks(TWO, "track=Monaco")) == ["Monaco"]


def test_a_sweep_over_tracks_stays_one_of_single_tracks():
    assert expand_grid(["track=Oval_track,Bowtie_track"]) == [["track=Oval_track"], ["track=Bowtie_track"]]
    assert expand_grid([TWO, "seed=0,1"]) == [[TWO, "seed=0"], [TWO, "seed=1"]]
    lists = expand_grid(["track=[Oval_track,Monaco],all", "track.2022_summit_speedway.weight=2"])
    assert [line for line, _ in lists] == ["track=[Oval_track,Monaco]", "track=all"]


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (["track=[Oval_trak]"], r"no such track Oval_trak \(did you mean Oval_track\?\)"),
        (["track=al"], "track=al: no such track"),
        (["track=[]"], r"track=\[\]: no track; accepted: track=\[A,B\], track=all"),
        (["track=[Monaco,Monaco]"], "Monaco is listed twice; track.Monaco.weight=2"),
        ([TWO, "track.Ovl_track.weight=2"], r"Ovl_track is neither .* \(did you mean Oval_track\?\)"),
        ([TWO, "track.Monaco.weight=2"], "Monaco is neither a chosen track nor a key of all tracks"),
        ([TWO, "track.wieght=2"], r"wieght is neither .* \(did you mean weight\?\)"),
        ([TWO, "track.floor.frction=2"], r"track.floor.frction: no such key \(did you mean friction\?\)"),
        (
            [TWO, "track.Oval_track.wieght=2"],
            r"track.Oval_track.wieght: no such key \(did you mean weight\?\)",
        ),
        ([TWO, "track.Oval_track.weight=0"], "track.Oval_track.weight=0: input should be greater than 0"),
        (
            [TWO, "track.Oval_track.weight=abc"],
            'track.Oval_track.weight="abc": input should be a valid number',
        ),
        ([TWO, "track.direction=sideways"], 'track.Oval_track.direction="sideways": input should be'),
        ([TWO, "track.Oval_track.width_m=[1,2]"], "track.Oval_track.width_m without track.Oval_track.knots"),
        ([TWO, "+track.Oval_track.foo=2"], "track.Oval_track.foo: no such key"),
        (["track.Oval_track.weight=2"], r"accepted with several tracks .* write track.weight"),
        (["track.2022_summit_speedway.weight=2"], "accepted with several tracks"),
        (["track.weight=abc"], 'track.weight="abc": input should be a valid number'),
        (
            [TWO, "collector.cars=1"],
            "collector.cars=1 with 2 tracks: every track needs",
        ),
    ],
)
def test_what_is_not_accepted_is_one_line(overrides, says):
    assert re.search(says, refusal(*overrides))
