"""The controller for a caller's own loop: it owns the jitted calls and the clock.

``Controller`` is a record of pure functions for ``jit``, ``scan`` and ``vmap``. ``ControlLoop`` is
for a host that has one robot, samples it and sends commands: it decides when to plan, looks at the
first sample, and says so when it is called at another rate than the controller was built for.
"""

import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from math import inf

import jax
import jax.numpy as jnp
import numpy as np

from kjax.controllers.command import check_command
from kjax.controllers.controller import build_controller
from kjax.controllers.observation import check_observation, check_shapes
from kjax.controllers.params import ControllerParams, condense, with_params
from kjax.controllers.state import ControllerState, PlanInfo
from kjax.legs.posture import standing
from kjax.spec import ControllerSpec
from kjax.types import JointCommand, Observation

PERIOD_TOLERANCE = 0.2  # relative error of the period that is told
PERIOD_CALLS = 100  # calls that the period is taken over


class ControlLoop:
    """One robot's controller, called once per ``act_dt``.

    Attributes:
      params: of the controller; replace them at any time, e.g. for another command: what is
        condensed from them is built again, in milliseconds.
      state: of the controller; ``None`` before the first call.
      info: of the last plan; ``None`` before the first call.
    """

    def __init__(self, spec: ControllerSpec, params: ControllerParams):
        """The loop before its first sample. Compiles, which takes seconds, so that no robot waits.

        Args:
          spec: from ``resolve``.
          params: likewise.
        """
        controller = build_controller(spec)
        self._spec = spec
        self.params = params
        self.state: ControllerState | None = None
        self.info: PlanInfo | None = None
        self._controller = controller
        self._dtype = jnp.zeros(()).dtype
        self._init = jax.jit(controller.init)
        self._plan, self._act = jax.jit(controller.plan), jax.jit(controller.act)
        crouch = self._as_arrays(standing())
        self._compile(crouch)
        # The look at the first sample compiles too; what it says of a made-up one is of no matter.
        with suppress(ValueError), warnings.catch_warnings(action="ignore"):
            check_observation(params.robot, crouch)
        state, _ = self._plan(self._tables, self._init(self._tables, crouch), crouch)
        jax.block_until_ready(self._act(self._tables, state, crouch))
        self._next_plan = self._last = -inf
        self._periods: list[float] = []
        self._told = False

    def _compile(self, sample: Observation) -> None:
        """Compile the three functions side by side; the calls that follow find them compiled."""
        state = jax.eval_shape(self._init, self._tables, sample)
        lowered = [
            self._init.lower(self._tables, sample),
            self._plan.lower(self._tables, state, sample),
            self._act.lower(self._tables, state, sample),
        ]
        with ThreadPoolExecutor(len(lowered)) as pool:
            list(pool.map(lambda one: one.compile(), lowered))

    @property
    def params(self) -> ControllerParams:
        """Parameters of the controller."""
        return self._params

    @params.setter
    def params(self, params: ControllerParams) -> None:
        self._params, self._tables = params, condense(self._spec, params)

    def command(self, **columns: float) -> None:
        """Ask for these values from now on, for 0 elsewhere; compiles nothing.

        Args:
          columns: of ``types.COMMAND_NAMES``, e.g. ``v_x=0.3``.

        Raises:
          ValueError: for a name that is no column, a value that is not finite, or another than 0
            in a column that this controller does not follow.
        """
        command = self._params.command.hold(**columns)
        given = {name: (value,) for name, value in columns.items()}
        check_command(given, planar=self._spec.spatial is None)
        self._params = self._params._replace(command=command)
        self._tables = with_params(self._tables, command=command)

    def reset(self) -> None:
        """Forget the robot: the next call begins anew."""
        self.state = self.info = None
        self._next_plan = self._last = -inf
        self._periods, self._told = [], False

    def step(self, observation: Observation, time: float) -> JointCommand:
        """Torques and PD loops, NumPy arrays (4, 3): abduction, thigh, calf of FR, FL, RR, RL.

        Args:
          observation: of the robot now.
          time: now, on any clock that runs on [s].

        Raises:
          ValueError: for an observation of the wrong shape or type, a first one in another
            convention (``observation.check_observation``), and a time that does not run on.

        Warns:
          UserWarning: once, if the time between calls is not the controller's ``act_dt``.
        """
        check_shapes(observation)
        if not np.isfinite(time) or time <= self._last:
            raise ValueError(
                f"time must run on from {self._last:g} s, got {time:g} s; after a restart of the "
                "robot call reset()"
            )
        observation = self._as_arrays(observation)
        if self.state is None:
            check_observation(self.params.robot, observation)
            self.state = self._init(self._tables, observation)
            self._next_plan = time
        else:
            self._watch(time - self._last)
        self._last = time
        if time >= self._next_plan - 0.5 * self._controller.act_dt:
            self.state, self.info = self._plan(self._tables, self.state, observation)
            late = time - self._next_plan > self._controller.control_dt
            start = time if late else self._next_plan
            self._next_plan = start + self._controller.control_dt
        self.state, command = self._act(self._tables, self.state, observation)
        return jax.device_get(command)

    def _as_arrays(self, observation: Observation) -> Observation:
        """The sample as arrays of one type, so that lists or float32 compile nothing again."""
        return jax.tree.map(
            lambda value: np.asarray(value, self._dtype),
            observation,
            is_leaf=lambda value: not isinstance(value, Observation),
        )

    def _watch(self, period: float) -> None:
        """Tell once of another period than the legs' paths are timed for."""
        if self._told:
            return
        self._periods.append(period)
        if len(self._periods) < PERIOD_CALLS:
            return
        # Without the extremes: a pause is no rate.
        tenth = PERIOD_CALLS // 10
        period = float(np.mean(np.sort(self._periods)[tenth:-tenth]))
        wanted = self._controller.act_dt
        self._periods = []
        if abs(period / wanted - 1.0) <= PERIOD_TOLERANCE:
            return
        self._told = True
        warnings.warn(
            f"the loop is called every {1e3 * period:.3g} ms, the controller was built for "
            f"{1e3 * wanted:.3g} ms: swing legs run at the wrong speed; set leg.act_dt = "
            f"{period:.4g} or change the rate",
            stacklevel=3,
        )
