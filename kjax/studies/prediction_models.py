"""The prediction models that the studies compare: name in tables -> config keys."""

from typing import Any

MEASURED = {"koopman.feet": "measured"}
MODELS: dict[str, dict[str, Any]] = {
    "linear (the paper)": {"koopman.model": "linear"},
    "linear, cautious": {"koopman.model": "linear", "lmpc.uncertainty_discount": 1.0},
    "linear, measured feet": {"koopman.model": "linear", **MEASURED},
    "linear, measured feet, p = 2": {"koopman.model": "linear", "koopman.order": 2, **MEASURED},
    "SRB at hover": {"koopman.model": "srb_hover", **MEASURED},
    "SRB re-linearised": {"koopman.model": "srb", **MEASURED},
    "planted SRB": {"koopman.model": "planted", **MEASURED},
    "exact bilinear": {"koopman.model": "exact", **MEASURED},
    "bilinear EDMD": {
        "koopman.model": "bilinear", "koopman.constant_rotation": True, **MEASURED,
    },
}  # fmt: skip


def residual(file: str) -> dict[str, Any]:
    """Keys of a residual model that ``whole_body.py`` left."""
    return {
        "koopman.model": "residual", "koopman.file": file, "koopman.dataset.dt": 0.005, **MEASURED,
    }  # fmt: skip
