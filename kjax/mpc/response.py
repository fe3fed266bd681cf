"""What a model of the body in three dimensions predicts from, and what it gives to the LMPC."""

from collections.abc import Callable
from typing import NamedTuple

from jaxtyping import Array, Float

from kjax.dynamics.srb_spatial import BodyState, SpatialBody
from kjax.koopman.so3 import So3Model
from kjax.prediction.residual_wrench import ResidualWrench

STATE = 12  # errors that the cost weighs: attitude, place, angular velocity, velocity


class Targets(NamedTuple):
    """What the body shall do at the nodes' ends.

    Attributes:
      R: (K, 3, 3) attitude, trunk to world [-].
      p: (K, 3) centre of mass [m].
      omega: (K, 3) angular velocity, world [rad/s].
      v: (K, 3) velocity [m/s].
      heading: (K, 2) cosine and sine of the heading that weights are given in [-].
      force: (K, 4, 3) force of each leg that costs nothing [N].
    """

    R: Float[Array, "K 3 3"]
    p: Float[Array, "K 3"]
    omega: Float[Array, "K 3"]
    v: Float[Array, "K 3"]
    heading: Float[Array, "K 2"]
    force: Float[Array, "K 4 3"]


class Response(NamedTuple):
    """Prediction about a nominal roll-out, by this model or another one, of n states x.

    Attributes:
      states: nominal ones (K + 1, ...), the first one now.
      omega: (K, 3) nominal angular velocity at the nodes' ends [rad/s].
      A: (K, n, n).
      B: (K, 4, n, 3) of each leg's force.
      outputs: (K, 12, n) changes of attitude (a turn of the nominal one, world), place, angular
        velocity and velocity by x at the nodes' ends.
    """

    states: BodyState
    omega: Float[Array, "K 3"]
    A: Float[Array, "K n n"]
    B: Float[Array, "K 4 n 3"]
    outputs: Float[Array, "K 12 n"]


class PredictionTask(NamedTuple):
    """What a model predicts from, world frame.

    Attributes:
      body: mass and inertia.
      start: now.
      length: (K,) of the nodes [s].
      feet: (K, 4, 3) contact points of each leg in each node [m].
      nominal: (K, 4, 3) forces that the prediction is made about, 0 in the air [N].
      targets: at the nodes' ends.
      learned: what was found from data, of the models that are learned.
      phase: (K,) part of the gait's phase that is over in the node's middle, for a residual [-].
    """

    body: SpatialBody
    start: BodyState
    length: Float[Array, "K"]
    feet: Float[Array, "K 4 3"]
    nominal: Float[Array, "K 4 3"]
    targets: Targets
    learned: So3Model | ResidualWrench | None = None
    phase: Float[Array, "K"] | None = None


Prediction = Callable[[PredictionTask], Response]
