"""What shapes a controller's compiled program; all else is data in ``ControllerParams``.

Two controllers share a compilation exactly when their specs are equal. A spec is made by
``kjax.controllers.resolve``; it is hashable, so it may be a static argument or a key.
"""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class DictionarySpec:
    """Observables of an EDMD model.

    Attributes:
      dictionary: "paper", "paper_literal", "monomials" or "fourier".
      order: highest power of the pitch rate, or highest degree of the monomials.
      fourier_count: number of random Fourier features.
      fourier_scale: their spread of frequencies.
      fourier_seed: of their draw.
      constant_rotation: whether R itself is one of them.
    """

    dictionary: str = "paper"
    order: int = 4
    fourier_count: int = 20
    fourier_scale: float = 1.0
    fourier_seed: int = 0
    constant_rotation: bool = False


@dataclass(frozen=True, kw_only=True)
class ModelSpec:
    """Prediction model of a contact mode.

    Attributes:
      kind: its name, see ``kjax.prediction.kind``.
      dt: its own step [s].
      dictionary: of "linear" and "bilinear"; ``None`` for the others.
      features: that a residual is fitted to, by name; empty for the others.
      lifted: number of learned observables; 0 for the others.
      measured_feet: whether contact points are the robot's own rather than nominal ones.
      tabulated: whether tables made once serve, wherever the robot is.
    """

    kind: str = "linear"
    dt: float = 0.001
    dictionary: DictionarySpec | None = None
    features: str = ""
    lifted: int = 0
    measured_feet: bool = False
    tabulated: bool = True


@dataclass(frozen=True, kw_only=True)
class CycleSpec:
    """Horizon over a gait cycle, through flight.

    Attributes:
      nodes: largest number of nodes of a gait's cycle.
      linearise: what the prediction is made about: a forecast path, or the last plan's roll-out.
      tolerance: relative residuals and gap at which the QP counts as solved [-].
      max_iterations: limit of the QP.
    """

    nodes: int
    linearise: Literal["forecast", "last_plan"] = "forecast"
    tolerance: float = 1e-6
    max_iterations: int = 30

    @property
    def grid(self) -> int:
        """Number of nodes of a horizon.

        The present phase may hold one more, part of them now and part a cycle later.
        """
        return self.nodes + 1


@dataclass(frozen=True, kw_only=True)
class SpatialSpec:
    """The LMPC in three dimensions, on the momentum form of the rigid body.

    Attributes:
      nodes: largest number of nodes of the horizon.
      feet: largest number of feet that press, over all nodes.
      model: that predicts, one of ``mpc.rigid_models.PREDICTIONS``.
      tolerance: relative residuals and gap at which the QP counts as solved [-].
      max_iterations: limit of the QP.
    """

    nodes: int
    feet: int
    model: str = "momentum"
    tolerance: float = 1e-6
    max_iterations: int = 200


@dataclass(frozen=True, kw_only=True)
class ControllerSpec:
    """Static choices of a controller.

    Attributes:
      base: "planar" or "free".
      act_dt: time between two calls of ``act`` [s].
      control_dt: time between two calls of ``plan`` [s].
      model_dt: step of the prediction within a stance [s].
      horizon: its number of steps.
      model: that predicts within a stance.
      discounts_uncertainty: whether uncertain steps of the horizon weigh less.
      friction_rows: whether friction limits forces, within a stance.
      torque_rows: whether joint torques do.
      solver: of the box QP: "tableau", "admm" or "projected_gradient".
      warm_start: whether the tableau is carried from tick to tick.
      tolerance: relative KKT residual at which a QP counts as solved [-].
      max_iterations: limit of the QP.
      cycle: horizon through flight; ``None`` where no gait has one.
      spatial: the LMPC in three dimensions; ``None`` for the planar one.
      gaits: number of phases of each gait, and of its levels of a ramp.
      modes: contact mode of each problem within a stance; see ``ControllerParams.problem``.
    """

    base: Literal["planar", "free"] = "free"
    act_dt: float = 0.001
    control_dt: float = 0.005
    model_dt: float = 0.001
    horizon: int = 6
    model: ModelSpec = ModelSpec(dictionary=DictionarySpec())
    discounts_uncertainty: bool = False
    friction_rows: bool = True
    torque_rows: bool = True
    solver: Literal["tableau", "admm", "projected_gradient"] = "tableau"
    warm_start: bool = True
    tolerance: float = 1e-9
    max_iterations: int = 2000
    cycle: CycleSpec | None = None
    spatial: SpatialSpec | None = None
    gaits: tuple[tuple[int, int], ...] = ()
    modes: tuple[int, ...] = ()
