"""``kjax study NAME``: studies that no verb of their own starts, and users' own."""

import sys
from collections.abc import Sequence
from types import FunctionType

from kjax.lookup import look_up
from kjax.options import fail, program

STUDIES = {
    "invariance": "does a walk depend on where zero is, on its floor, its heading, float32?",
    "raw_steps": "steps of the command without a ramp, at random phases",
    "koopman_study": "which models predict the rigid body, how far, and how sure",
    "whole_body": "residual models from recordings of the whole robot",
    "model_walks": "what each prediction model walks like, tuned alike",
    "learn_control": "a dictionary learned through the closed loop",
    "spatial": "in three dimensions: commands, grounds unseen, pushes, speeds, switches",
    "spatial_models": "which models of the body in three dimensions predict how far",
    "spatial_walks": "what each of them walks like in three dimensions, tuned alike",
    "spatial_residual": "what the rigid body in three dimensions misses of the whole robot",
    "robots": "one config on robots of 12 to 127 kg: what each of them can",
    "showreel": "the moving picture of the README: gaits and grounds, one after another",
}
_PACKAGES = {
    "whole_body": "kjax.studies.whole_body.study",
    "spatial": "kjax.studies.spatial.study",
    "spatial_models": "kjax.studies.spatial_models.study",
    "spatial_walks": "kjax.studies.spatial_walks.study",
    "spatial_residual": "kjax.studies.spatial_residual.study",
    "robots": "kjax.studies.robots.study",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Start the study that the first word names."""
    from kjax.commands.main import start_module

    words = list(sys.argv[1:] if argv is None else argv)
    if not words or words[0] in ("-h", "--help"):
        print("usage: kjax study NAME [options]\n")
        print("\n".join(f"  {name:16} {text}" for name, text in STUDIES.items()))
        print("\n  module:main    a study of your own; its folder in PYTHONPATH")
        return 0
    name, called = words[0], f"kjax study {words[0]}"
    if ":" in name:
        try:
            main = look_up("study", name, STUDIES, FunctionType)
        except ValueError as error:
            fail(str(error))
        with program(called):
            return int(main(words[1:]))
    if name not in STUDIES:
        fail(f"{called}: wanted one of {', '.join(STUDIES)}, or 'module:main' for your own")
    return start_module(_PACKAGES.get(name, f"kjax.studies.{name}"), called, words[1:])
