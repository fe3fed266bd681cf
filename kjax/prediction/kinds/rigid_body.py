"""The rigid body itself: linearised level and at rest once, or where the robot is at every tick."""

from typing import Any

import jax
import jax.numpy as jnp

from kjax.koopman.observables import states_only
from kjax.prediction import families
from kjax.prediction.families import BodyModel
from kjax.prediction.kind import Bodies, ModelChoice, ModelKind
from kjax.types import STATE_DIM


def _hover(choice: ModelChoice, bodies: Bodies) -> tuple[Any, Any]:
    def one(body: Any, alpha: Any, height: Any) -> Any:
        return families.linearised_srb(body, alpha, height, choice.dataset.dt)

    heights = jnp.asarray(bodies.heights, float)
    return jax.vmap(one)(bodies.body, bodies.alpha, heights), _certain(bodies)


def _body(choice: ModelChoice, bodies: Bodies) -> tuple[Any, Any]:
    return BodyModel(bodies.body, bodies.alpha), _certain(bodies)


def _certain(bodies: Bodies) -> Any:
    return jnp.zeros((len(bodies.modes), STATE_DIM))


SRB_HOVER = ModelKind(
    family=lambda spec: families.linear(states_only(), spec.dt, "srb_hover"),
    params=_hover,
    of_height=True,
)
SRB = ModelKind(lambda spec: families.rigid_body(spec.dt), _body, is_body=True)
PLANTED = ModelKind(lambda spec: families.planted(spec.dt), _body, is_body=True)
EXACT = ModelKind(lambda spec: families.exact(spec.dt), _body, is_body=True)
