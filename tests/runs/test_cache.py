"""Finished results: shown for their own inputs and code only, and never lost."""

import dataclasses
import json
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from kjax.config import FitStudyConfig, RunConfig, fields, load_config
from kjax.files import FILE_KEYS
from kjax.prediction import storage
from kjax.runs import cache as cache_module
from kjax.runs.cache import Cache, CacheError, code_version, lock
from kjax.types import Mode


def retrain(path, value):
    spread = np.full((len(Mode), 6), value)
    return storage.save(
        path, storage.Stored("residual", 0.005, np.zeros((len(Mode), 6, 17)), spread)
    )


def with_file(path):
    keys = {"koopman.model": "residual", "koopman.file": str(path), "koopman.dataset.dt": 0.005}
    return load_config(RunConfig, None, keys | {"lmpc.model_dt": 0.005})


def test_a_result_is_found_again_by_its_inputs_whole(tmp_path):
    one = Cache(tmp_path)
    key = one.key(RunConfig(), "held", [1, 2.5])
    assert key not in one
    one.add({key: {"rmse": 0.1 + 0.2, "fell": False, "crossed": None, "cost": np.arange(3.0)}})
    again = Cache(tmp_path)
    assert again.key(RunConfig(), "held", [1, 2.5]) == key
    assert again[key] == {
        "rmse": 0.1 + 0.2, "fell": False, "crossed": None, "cost": [0.0, 1.0, 2.0]
    }  # fmt: skip
    assert len(again) == 1


def test_any_other_input_is_another_key(tmp_path):
    cache = Cache(tmp_path)
    keys = [
        cache.key(RunConfig()),
        cache.key(dataclasses.replace(RunConfig(), seed=1)),
        cache.key(RunConfig(), "held"),
        cache.key(RunConfig(), "every_step"),
        cache.key(RunConfig(), RunConfig()),
        cache.key(RunConfig(), [1, 2]),
        cache.key(RunConfig(), [2, 1]),
        cache.key(FitStudyConfig()),
    ]
    assert len(set(keys)) == len(keys)


def test_a_retrained_model_under_the_same_name_is_another_key(tmp_path):
    cache = Cache(tmp_path)
    config = with_file(tmp_path / "model")  # without .npz, as save and load take it
    missing = cache.key(config)
    retrain(tmp_path / "model", 1e-3)
    first = cache.key(config)
    assert first == cache.key(config) != missing
    retrain(tmp_path / "model", 2e-3)
    assert cache.key(config) != first


def test_every_config_key_that_names_a_file_is_hashed_by_content():
    named = [
        name for cls in (RunConfig, FitStudyConfig) for name, *_ in fields(cls)
        if name.rsplit(".", 1)[-1] in ("file", "path") or name.endswith(("_file", "_path"))
    ]  # fmt: skip
    assert set(named) == set(FILE_KEYS)


def test_a_robot_of_ones_own_is_hashed_by_content(tmp_path, monkeypatch):
    for number, mjcf in enumerate(("<mujoco/>", "<mujoco> </mujoco>")):
        (tmp_path / f"own{number}.xml").write_text(mjcf)
        (tmp_path / f"my_robot{number}.py").write_text(
            "from pathlib import Path\n"
            "from kjax.robots import Robot, get_robot\n"
            f"MJCF = Path(__file__).with_name('own{number}.xml')\n"
            "ROBOT = Robot(name='own', params=get_robot().params, mjcf=MJCF)\n"
        )
    monkeypatch.syspath_prepend(tmp_path)
    cache = Cache(tmp_path)
    config = dataclasses.replace(RunConfig(), robot="my_robot0:ROBOT")
    before = cache.key(config)
    assert before == cache.key(config)
    (tmp_path / "own0.xml").write_text("<mujoco model='other'/>")
    assert cache.key(config) != before


def test_results_of_other_code_are_neither_shown_nor_dropped(tmp_path):
    study = tmp_path / "study.py"
    found = []
    for text in ("SETS = 3", "SETS = 4", "SETS = 3"):
        study.write_text(text)
        cache = Cache(tmp_path, study)
        key = cache.key("inputs")
        found.append(key in cache and cache[key])
        cache.add({key: text})
    assert found == [False, False, "SETS = 3"]
    assert Cache(tmp_path).key("inputs") not in Cache(tmp_path)


def test_a_study_s_own_file_and_the_simulated_code_are_part_of_the_code(tmp_path, monkeypatch):
    file = tmp_path / "study.py"
    file.write_text("SETS = 3\n")
    before = code_version(file)
    assert before != code_version()
    file.write_text("SETS = 4\n")
    assert code_version(file) != before
    package = tmp_path / "kjax"
    (package / "viz").mkdir(parents=True)
    for name in ("sim.py", "viz/plots.py"):
        (package / name).write_text("one")
    monkeypatch.setattr(cache_module, "_PACKAGE", package)
    one = code_version()
    (package / "viz" / "plots.py").write_text("two")  # cannot change an episode
    assert code_version() == one
    (package / "sim.py").write_text("two")
    assert code_version() != one


@pytest.mark.parametrize("text", ["", "[1, 2]", "{", '{"results": {"a": 1}, "sha256": "0"}'])
def test_a_damaged_file_is_named_and_the_others_stay(tmp_path, text):
    cache = Cache(tmp_path)
    keys = [cache.key(number) for number in range(2)]
    for number, key in enumerate(keys):
        cache.add({key: number})
    first, second = sorted(cache.folder.iterdir())
    first.write_text(text)
    with pytest.raises(CacheError, match=rf"{first.name}: damaged; delete it and run again"):
        Cache(tmp_path)
    first.unlink()
    assert len(Cache(tmp_path)) == 1
    assert second.exists()


def test_a_value_that_was_changed_by_hand_is_seen(tmp_path):
    cache = Cache(tmp_path)
    cache.add({cache.key(1): {"rmse": 0.5}})
    (path,) = cache.folder.iterdir()
    path.write_text(path.read_text().replace("0.5", "0.4"))
    with pytest.raises(CacheError, match="damaged"):
        Cache(tmp_path)


def test_a_full_disk_keeps_what_was_finished(tmp_path, monkeypatch):
    cache = Cache(tmp_path)
    cache.add({cache.key(1): 1})

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(cache_module.os, "fsync", full)
    with pytest.raises(CacheError, match=r"No space left on device.*what was finished is kept"):
        cache.add({cache.key(2): 2})
    monkeypatch.undo()
    assert len(Cache(tmp_path)) == 1
    assert len(list(cache.folder.iterdir())) == 1


def _add(folder, values, ready):
    ready.wait()
    cache = Cache(folder)
    for number in values:
        cache.add({cache.key(number): number})


def test_two_at_once_lose_nothing(tmp_path):
    ready = threading.Barrier(2)
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda first: _add(tmp_path, range(first, 40, 2), ready), range(2)))
    cache = Cache(tmp_path)
    assert [cache[cache.key(number)] for number in range(40)] == list(range(40))


def test_what_another_run_added_is_seen_after_a_refresh(tmp_path):
    one, other = Cache(tmp_path), Cache(tmp_path)
    other.add({other.key(1): 1})
    assert other.key(1) not in one
    one.refresh()
    assert one[one.key(1)] == 1


def test_a_folder_may_be_kept_to_one_run(tmp_path):
    with (
        lock(tmp_path),
        pytest.raises(CacheError, match=r"in use by another run.*--out"),
        lock(tmp_path),
    ):
        pass
    with lock(tmp_path), lock(tmp_path, "lock.1"):
        pass


def test_arrays_are_kept_without_pickle(tmp_path):
    cache = Cache(tmp_path)
    assert cache.arrays("a") is None
    cache.add_arrays("a", {"x": np.arange(3.0), "fell": np.array([True])})
    held = Cache(tmp_path).arrays("a")
    np.testing.assert_array_equal(held["x"], [0.0, 1.0, 2.0])
    assert held["fell"].dtype == bool
    path = cache.path("a", ".npz")
    for length in (0, 10, 100):
        path.write_bytes(path.read_bytes()[:length])
        with pytest.raises(CacheError, match=r"a\.npz: damaged"):
            cache.arrays("a")
    np.savez(path, x=np.array([{}], object))  # a pickle inside
    with pytest.raises(CacheError, match="damaged"):
        cache.arrays("a")


def test_a_fresh_start_needs_no_undamaged_files(tmp_path):
    cache = Cache(tmp_path)
    cache.add({cache.key(1): 1})
    (path,) = cache.folder.iterdir()
    path.write_text("{")
    assert len(Cache(tmp_path, fresh=True)) == 0


def test_clear_drops_everything(tmp_path):
    cache = Cache(tmp_path)
    cache.add({cache.key(1): 1})
    cache.add_arrays("a", {"x": np.zeros(1)})
    cache.clear()
    assert len(cache) == 0
    assert list(cache.folder.iterdir()) == []


def test_files_are_json_that_others_can_read(tmp_path):
    cache = Cache(tmp_path)
    cache.add({cache.key(1): {"rmse": float("nan")}})
    (path,) = cache.folder.iterdir()
    assert list(json.loads(path.read_text())["results"].values()) == [{"rmse": None}]
