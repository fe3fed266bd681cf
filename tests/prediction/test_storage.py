"""Model files: what was saved comes back; whatever else lies there is one line about the file."""

import zipfile

import numpy as np
import pytest

from kjax.koopman.dataset import DatasetSpec
from kjax.koopman.models import BilinearModel
from kjax.prediction import build, storage
from kjax.prediction.kind import ModelChoice
from kjax.prediction.learned import Layer, LearnedModel
from kjax.types import Mode

M = len(Mode)
FEATURES = {"affine": 17, "history": 21, "clock": 25, "clock_history": 29}  # counted by hand


def residual(features="clock_history", **changes):
    W = np.arange(M * 6 * FEATURES[features], dtype=float).reshape(M, 6, -1)
    return storage.Stored("residual", 0.005, W, np.full((M, 6), 1e-3), features)._replace(**changes)


def learned():
    """Two layers, 3 learned observables: N = 10."""
    rng = np.random.default_rng(0)
    model = LearnedModel(
        layers=(
            Layer(rng.normal(size=(M, 8, 5)), rng.normal(size=(M, 8))),
            Layer(rng.normal(size=(M, 3, 8)), rng.normal(size=(M, 3))),
        ),
        head=BilinearModel(
            rng.normal(size=(M, 10, 10)), rng.normal(size=(M, 10, 10, 4)), np.zeros((M, 4, 10, 4))
        ),
        centre=rng.normal(size=(M, 6)),
        scale=np.ones((M, 6)),
    )
    return storage.Stored("learned", 0.001, model, np.full((M, 6), 1e-3))


def refusal(path, family="residual"):
    """The message of the ValueError that a file is refused with: one line with its name."""
    with pytest.raises(ValueError, match=r"^file: ") as caught:
        storage.load(path, family)
    text = str(caught.value)
    assert "\n" not in text
    assert path.name in text
    assert len(text.replace(str(path), "")) < 300
    return text


@pytest.mark.parametrize("features", list(FEATURES))
def test_a_residual_comes_back_as_it_was_saved(tmp_path, features):
    storage.save(tmp_path / "model.npz", residual(features))
    back = storage.load(tmp_path / "model.npz", "residual")
    np.testing.assert_array_equal(back.params, residual(features).params)
    assert (back.dt, back.features) == (0.005, features)


@pytest.mark.parametrize("name", ["model", "model.npz", "model.v2", "model.npz.old"])
def test_a_model_is_loaded_under_the_name_that_it_was_saved_under(tmp_path, name):
    written = storage.save(tmp_path / name, residual())
    assert list(tmp_path.iterdir()) == [written]
    assert storage.load(tmp_path / name, "residual").features == "clock_history"
    assert storage.load(str(tmp_path / name), "residual").dt == 0.005
    choice = ModelChoice(model="residual", file=str(tmp_path / name), dataset=DatasetSpec(dt=0.005))
    assert build.build_family(build.model_spec(choice)).name == "residual"


def test_a_file_without_an_ending_is_read_too(tmp_path):
    storage.save(tmp_path / "model", residual()).rename(tmp_path / "renamed")
    assert storage.load(tmp_path / "renamed", "residual").dt == 0.005


def test_a_save_that_fails_leaves_the_old_model(tmp_path, monkeypatch):
    storage.save(tmp_path / "model.npz", residual())

    def full(path, **arrays):
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OSError, match="No space"):
        storage.save(tmp_path / "model.npz", residual("affine"))
    assert storage.load(tmp_path / "model.npz", "residual").features == "clock_history"
    assert [path.name for path in tmp_path.iterdir()] == ["model.npz"]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "empty"),
        (b"\0" * 100, "no .npz"),
        (b"hello\n", "no .npz"),
        (b"PK\x03\x04", "cut off"),
        (b"\x93NUMPY\x01\x00", "cut off"),
        ("größer".encode("latin-1"), "no .npz"),
    ],
)
def test_an_empty_or_foreign_file_is_named(tmp_path, content, said):
    path = tmp_path / "model.npz"
    path.write_bytes(content)
    assert said in refusal(path)


def test_a_missing_file_and_a_folder_are_named(tmp_path):
    assert "No such file" in refusal(tmp_path / "none.npz")
    (tmp_path / "folder.npz").mkdir()
    assert "directory" in refusal(tmp_path / "folder.npz")


def test_other_arrays_are_no_model(tmp_path):
    np.save(tmp_path / "array.npy", np.zeros(3))
    assert "one bare array" in refusal(tmp_path / "array.npy")
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    assert "holds no model, wanted a residual model" in refusal(tmp_path / "other.npz")
    np.savez(tmp_path / "objects.npz", family=np.array({"a": 1}, dtype=object))
    refusal(tmp_path / "objects.npz")
    np.savez(tmp_path / "words.npz", family=np.array(["residual", "learned"]))
    assert "holds no model" in refusal(tmp_path / "words.npz")
    with zipfile.ZipFile(tmp_path / "notes.npz", "w") as archive:
        archive.writestr("family", "residual")  # a zip of text
    refusal(tmp_path / "notes.npz")


def test_a_file_cut_off_anywhere_is_refused(tmp_path):
    whole = storage.save(tmp_path / "whole.npz", residual()).read_bytes()
    path = tmp_path / "model.npz"
    lengths = range(0, len(whole), len(whole) // 40)
    assert len(lengths) >= 40
    for length in lengths:
        path.write_bytes(whole[:length])
        assert refusal(path).startswith("file: "), length  # see there what else is asserted


@pytest.mark.parametrize(("stored", "family"), [(residual(), "residual"), (learned(), "learned")])
def test_a_damaged_byte_is_refused_or_does_not_matter(tmp_path, stored, family):
    """Every member of a zip carries a checksum; what none covers may only be a date."""
    path = tmp_path / "model.npz"
    whole = storage.save(path, stored).read_bytes()
    rng = np.random.default_rng(0)
    refused, harmless = 0, 0
    for at in rng.integers(0, len(whole), 150):
        content = bytearray(whole)
        content[at] ^= int(rng.integers(1, 256))
        path.write_bytes(content)
        try:
            back = storage.load(path, family)
        except ValueError as error:
            refused += "\n" not in str(error)
        else:
            harmless += 1
            np.testing.assert_array_equal(back.spread, stored.spread)
    assert refused + harmless == 150
    assert refused > 100


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"W": np.zeros((M, 6, 28))}, f"W has shape ({M}, 6, 28), wanted ({M}, 6, 29)"),
        ({"W": np.zeros((M, 5, 29))}, f"W has shape ({M}, 5, 29), wanted ({M}, 6, 29)"),
        ({"W": np.zeros((6, 29))}, f"W has shape (6, 29), wanted ({M}, 6, 29)"),
        ({"W": np.zeros((5, 6, 29))}, f"W holds 5 contact modes, wanted {M}: fit it again"),
        ({"W": np.zeros((3, 6, 29))}, f"W holds 3 contact modes, wanted {M}"),
        ({"W": np.zeros((M, 6, 29), complex)}, "W holds complex values"),
        ({"W": np.full((M, 6, 29), "a")}, "W holds values of type <U1"),
        ({"W": np.zeros((M, 6, 29), bool)}, "W holds values of type bool"),
        ({"W": np.zeros((0, 6, 29))}, f"W holds 0 contact modes, wanted {M}"),
        ({"W": None}, "lacks 'W'"),
        ({"features": np.array("affine")}, f"W has shape ({M}, 6, 29), wanted ({M}, 6, 17)"),
        ({"spread": np.zeros((M, 4))}, f"spread has shape ({M}, 4), wanted ({M}, 6)"),
        ({"spread": -np.ones((M, 6))}, "spread holds -1, wanted values of at least 0"),
        ({"spread": None}, "lacks 'spread'"),
        ({"dt": np.array([0.005, 0.005])}, "dt has shape (2,), wanted ()"),
        ({"dt": np.array(0.0)}, "dt holds 0, wanted values above 0"),
        ({"dt": np.array(0.005 + 0j)}, "dt holds complex values"),
        ({"dt": np.array("0.005")}, "dt holds values of type <U5"),
        ({"dt": np.array(np.nan)}, "dt holds values that are not finite"),
    ],
)
def test_an_array_that_does_not_fit_a_residual_is_named(tmp_path, change, said):
    path = storage.save(tmp_path / "model.npz", residual())
    arrays = {**np.load(path), **change}
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})
    assert said in refusal(path)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"W_0": np.zeros((M, 8, 6))}, f"W_0 has shape ({M}, 8, 6), wanted ({M}, 8, 5)"),
        ({"W_0": np.zeros((8, 5))}, "W_0 has shape (8, 5), wanted (modes, out, in)"),
        ({"W_1": np.zeros((M, 3, 7))}, f"W_1 has shape ({M}, 3, 7), wanted ({M}, 3, 8)"),
        ({"W_0": None}, "lacks 'W_0'"),
        ({"W_0": None, "W_1": None}, "lacks 'W_0'"),
        ({"b_1": np.zeros((M, 4))}, f"b_1 has shape ({M}, 4), wanted ({M}, 3)"),
        ({"b_0": None}, "lacks 'b_0'"),
        ({"A": np.zeros((M, 10, 9))}, f"A has shape ({M}, 10, 9), wanted ({M}, 10, 10)"),
        ({"B": np.zeros((M, 10, 10, 2))}, f"B has shape ({M}, 10, 10, 2), wanted ({M}, 10, 10, 4)"),
        (
            {"B_feet": np.zeros((M, 4, 9, 4))},
            f"B_feet has shape ({M}, 4, 9, 4), wanted ({M}, 4, 10, 4)",
        ),
        ({"centre": np.zeros((M, 5))}, f"centre has shape ({M}, 5), wanted ({M}, 6)"),
        ({"scale": np.zeros((M, 6))}, "scale holds 0, wanted values above 0"),
        ({"A": np.zeros((M, 10, 10), np.complex64)}, "A holds complex values"),
    ],
)
def test_an_array_that_does_not_fit_a_learned_model_is_named(tmp_path, change, said):
    path = storage.save(tmp_path / "model.npz", learned())
    arrays = {**np.load(path), **change}
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})
    assert said in refusal(path, "learned")


@pytest.mark.parametrize("name", [".", "/"])
def test_a_path_without_a_name_is_no_file(name):
    with pytest.raises(ValueError, match=r"file: .* is no file"):
        storage.load(name, "residual")
