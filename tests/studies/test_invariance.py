"""The study on invariance: what it calls met, and what a quick call leaves."""

import json

import pytest

from kjax.studies import invariance


def study(folder, *words):
    words = ["--models", "srb", "--gaits", "trot", "--out", str(folder), *words]
    assert invariance.main(words) == 0
    return json.loads((folder / "results.json").read_text(encoding="utf-8"))["parts"]


def test_the_cells_differ_in_where_zero_is_and_in_nothing_else(engine, tmp_path):
    parts = study(tmp_path)
    assert [(one["check"], len(one["cells"])) for one in parts] == [
        ("place", 16), ("float32", 12), ("heading", 3),
    ]  # fmt: skip
    assert all(one["met"] and one["largest"] == 0.0 for one in parts)
    places = {(c.sim.start[0], c.sim.floor) for c in engine.count if c.sim.base == "planar"}
    assert len(places) == 16
    assert {c.sim.heading for c in engine.count if c.sim.base == "free"} == {0.0, 1.0, 2.0}
    assert all(c.sim.cone == "elliptic" for c in engine.count if c.sim.base == "free")
    assert (tmp_path / "figure.png").exists()


def test_a_cell_that_walks_otherwise_is_named_and_not_met(engine, tmp_path):
    engine.error = lambda config: 1e-3 * (config.sim.start[0] == 1e4)
    place, single, _ = study(tmp_path)
    assert place["met"] is False
    assert place["largest"] == pytest.approx(0.05)
    assert place["largest_at"][0] == 1e4
    assert single["met"] is True  # it goes to 1 km
    assert "| NO |" in (tmp_path / "table.md").read_text(encoding="utf-8")


def test_finished_batches_are_not_run_again_and_other_parts_stay_on_the_page(engine, tmp_path):
    study(tmp_path, "--checks", "place")
    before = len(engine.count)
    parts = study(tmp_path, "--checks", "heading")
    assert len(engine.count) == before + 3
    assert [one["check"] for one in parts] == ["place", "heading"]


@pytest.mark.parametrize("words", [["--seeds", "0"], ["--gaits", "walk"], ["--residual", "none"]])
def test_a_mistake_is_one_line_and_exit_code_2(engine, capsys, words):
    with pytest.raises(SystemExit) as caught:
        invariance.main(words)
    assert caught.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1
