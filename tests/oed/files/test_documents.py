"""Documents that are not what they should be: one line that names the key, whatever is wrong."""

from __future__ import annotations

import json
import time

import pytest

from benchmarks.campaign.settings import campaign_from_toml
from estimators.sessions.settings import Settings, settings_from_json, settings_to_json
from oed.errors import CampaignError, InputError
from oed.plants.json import plant_from_json, plant_to_json

PLANT = '{"num": [[[0, 0.2]]], "den": [[[1, -0.9]]], "dt": 1}'


def with_entry(entry: str) -> str:
    return PLANT[:-1] + ", " + entry + "}"


@pytest.mark.parametrize(
    "text, words",
    [
        (
            with_entry('"noise": {"varance": 2}'),
            "the key 'varance' in noise is unknown .did you mean variance",
        ),
        (with_entry('"dt": 2'), "the key 'dt' occurs twice"),
        (with_entry('"noise": {"variance": 1, "variance": 2}'), "'variance' occurs twice"),
        (with_entry('"noise": {"variance": 1, "covariance": [[2]]}'), "variance and a covariance"),
        (with_entry('"noise": {"variance": NaN}'), "the number NaN; numbers must be finite"),
        (with_entry('"noise": {"variance": 1e999}'), "the number '1e999'"),
        (with_entry('"noise": {"variance": -1}'), "noise.variance is -1; it must be a number of at least 0"),
        (with_entry('"noise": {"filter": {"num": [1]}}'), "the key 'noise.filter.den' is missing"),
        (with_entry('"noise": []'), r"noise is \[\]; it must be an object of variance, covariance, filter"),
        (with_entry('"A": [[1]]'), "one of the two ways"),
        (with_entry(f'"name": {"9" * 5000}'), "a number of 5000 digits"),
        (with_entry('"free": "b1"'), "free is 'b1'; it must be a list of parameters' names"),
        (PLANT.replace("1}", '"1"}'), "dt is '1'; it must be the sampling time in seconds"),
        (PLANT.replace("1}", "true}"), "dt is True"),
        (PLANT.replace("0.2", '"0.2"'), r"num is \[\[\[0, '0.2'\]\]\]; it must be a list of at most"),
        (PLANT.replace("[[[1, -0.9]]]", "[[[1e-320, -0.9]]]"), r"den\[0\]\[0\] begins with 1e-320"),
        (PLANT.replace("[[[1, -0.9]]]", "[]"), r"den is \[\]"),
        (PLANT.replace("[[[1, -0.9]]]", "[[[1], 2]]"), "den is"),
        ('{"num": [1]}', "needs num and den"),
        ('{"A": [[0.5]], "B": [[1], [2]], "C": [[1]], "dt": 1}', "B"),
        ('{"A": [[0.5], [1, 2]], "B": [[1]], "C": [[1]], "dt": 1}', "A"),
        ("[1]", "it is .1.; it must be an object"),
        ("[" * 100_000, "nested too deeply"),
        ('{"num": ' + "[" * 990 + "1" + "]" * 990 + ', "den": [1]}', "num is|nested too deeply"),
        ("", "is not JSON .line 1"),
        ("{", "is not JSON"),
        (PLANT.encode("utf-16"), "is not text in UTF-8"),
        (b"\xff\xfe\x00", "is not text in UTF-8"),
    ],
    ids=lambda value: repr(value)[:40],
)
def test_a_wrong_plant_file_is_one_line_that_names_the_key(tmp_path, text, words):
    file = tmp_path / "p.json"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=words) as caught:
        plant_from_json(file)
    assert len(str(caught.value)) < 700


def test_what_is_right_is_read_bit_for_bit(tmp_path):
    file = tmp_path / "p.json"
    file.write_bytes(b"\xef\xbb\xbf" + PLANT.encode())  # with the mark that some editors put in front
    plant = plant_from_json(file)
    assert json.dumps(plant_to_json(plant)) == json.dumps(
        plant_to_json(plant_from_json(plant_to_json(plant)))
    )
    assert plant.num[0][0].tolist() == [0.0, 0.2]


@pytest.mark.parametrize(
    "text, words",
    [
        ("noise_variances = [nan]", r"noise_variances\[0\] is nan; numbers must be finite"),
        ("samples = 100\nsamples = 200", "is not TOML .Cannot overwrite"),
        ("samples = 10.5", "samples is 10.5; it must be a whole number"),
        ("varance = 1", "the key 'varance' is unknown"),
        ("[[limit]]\nplant = 'x'", r"the key 'limit\[0\].replicates' is missing"),
        ("seed = 1" + "0" * 400, "whole number beyond|not TOML"),
        ("a = " + "[" * 20_000, "is not TOML"),
    ],
    ids=lambda value: repr(value)[:40],
)
def test_a_wrong_campaign_file(tmp_path, text, words):
    file = tmp_path / "c.toml"
    file.write_text(text)
    with pytest.raises(InputError, match=words):
        campaign_from_toml(file)


@pytest.mark.parametrize(
    "key, value, words",
    [
        ("sampels", 5, "'sampels' is unknown .did you mean samples"),
        ("samples", "5", "samples is '5'; it must be a whole number"),
        ("power", [1], "power is .1.; it must be a number, or null"),
        ("inputs", "u", "inputs is 'u'; it must be a list"),
        ("centre", 1, "centre is 1; it must be true or false"),
        ("samples", 10**9, "samples is 1000000000; it must be a whole number from 4 to 10,000,000"),
        ("periods", 10**6, "each file would hold 100,000,000 numbers"),
        ("dt", 1e308, "the sampling time is 1e.308"),
        ("dt", 1e400, "the number Infinity"),
    ],
)
def test_a_wrong_session_file(key, value, words):
    content = json.loads(settings_to_json(Settings("power", 100)))
    with pytest.raises(CampaignError, match=words):
        settings_from_json(json.dumps(content | {key: value}), "session.json")
    assert settings_from_json(json.dumps(content), "session.json") == Settings("power", 100)


@pytest.mark.parametrize(
    "text, words",
    [
        ('{"num": ' + "[[1]]," * 400_000 + '"den": 1}', "has more than 1,000,000 values"),
        ("{" + ",".join(f'"k{k}": 1' for k in range(1_000_001)) + "}", "has more than 1,000,000 values"),
        (" " * (64 * 2**20 + 1), "has 67,108,865 bytes; at most 67,108,864 are read"),
    ],
    ids=["lists", "keys", "bytes"],
)
def test_documents_of_gigabytes_once_read_are_refused_before(tmp_path, text, words):
    file = tmp_path / "p.json"
    file.write_text(text)
    began = time.process_time()
    with pytest.raises(InputError, match=words):
        plant_from_json(file)
    assert time.process_time() - began < 2
    toml = tmp_path / "c.toml"
    toml.write_text("#" * (2**20 + 1))
    with pytest.raises(InputError, match="has 1,048,577 bytes; at most 1,048,576 are read"):
        campaign_from_toml(toml)


ARX = {"kind": "arx", "na": [1], "nb": [[1]], "nc": [0], "nd": [0], "nf": [[0]], "nk": [[1]]}


@pytest.mark.parametrize(
    "change, words",
    [
        ({"structure": ARX | {"nb": [[1e308]]}}, r"structure: nb.*1e.308"),
        ({"structure": ARX | {"nb": [[20000]]}}, "its orders ask for more parameters than the 2 of theta"),
        ({"structure": {"kind": "ss", "blocks": [20000] * 60}}, "its orders ask for more parameters"),
        ({"structure": ARX | {"nb": [[1], [1, 1]]}}, "the rows of nb are of different lengths"),
        ({"structure": ARX | {"nn": 1}}, "the key 'nn' is unknown"),
        ({"structure": ARX | {"kind": "x"}}, "kind is 'x'; it must be one of fir"),
        ({"theta": ["x", 1]}, r"theta\[0\] is 'x'; it must be a number"),
        ({"noise_covariance": [[1], [1, 1]]}, "the rows of noise_covariance are of different lengths"),
        ({"dt": 0}, "dt is 0; it must be a positive number"),
    ],
    ids=lambda value: repr(value)[:60],
)
def test_a_wrong_model_file_is_one_line(tmp_path, change, words):
    model = {"structure": ARX, "theta": [0.1, 0.2], "noise_covariance": [[1.0]], "dt": 0.5}
    file = tmp_path / "model.json"
    file.write_text(json.dumps(model))
    assert plant_from_json(file).den[0][0].tolist() == [1, 0.1]
    file.write_text(json.dumps(model | change))
    with pytest.raises(InputError, match=words):
        plant_from_json(file)
