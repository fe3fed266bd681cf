"""The Koopman models of a config: fitted once for all configs that share the choice."""

import warnings
from functools import lru_cache

import jax

from kjax.config import KoopmanConfig, RunConfig
from kjax.config.gaits import gait_setting, reachable_gaits
from kjax.config.units import InSi, in_si
from kjax.controllers.params import Fits
from kjax.controllers.resolve_model import koopman_keys, model_choice
from kjax.controllers.rigid_body import body_numbers, own_body
from kjax.controllers.walkable import build_gaits, contact_problems
from kjax.koopman.edmd import Point, fit_modes, stack_bodies
from kjax.prediction.build import build_prediction
from kjax.prediction.evaluation import force_response_error
from kjax.prediction.kind import ModelChoice, ModelKind, get_kind
from kjax.threads import one_blas_thread
from kjax.types import MODE_ALPHA, Mode, RobotParams

_fit_modes = jax.jit(fit_modes, static_argnames=("dictionary", "dataset", "measured_feet", "modes"))


def fit_models(config: RunConfig, robot: RobotParams) -> Fits:
    """Fit the Koopman models of a config; call it in float64.

    Configs that differ elsewhere, in weights or bounds, share one fit.
    """
    si = in_si(config, robot)
    gaits = build_gaits(si)
    problems, _ = contact_problems(gaits, si)
    names = [gaits[problem.gait].name for problem in problems]
    feet = tuple(_nominal_feet(si, robot, name) for name in names)
    modes = tuple(problem.mode for problem in problems)
    choice = model_choice(si.koopman)
    with koopman_keys():
        kind = get_kind(choice.model)
    heights = tuple(
        gait_setting(si, name, "body_height") if kind.of_height else 0.0 for name in names
    )
    # What a file holds may have changed since.
    fit = _fit.__wrapped__ if choice.file else _fit
    mass, inertia = (float(number) for number in body_numbers(si, robot))
    with koopman_keys():
        return fit(mass, inertia, choice, kind, si.koopman.dataset.seed, modes, feet, heights)


def _nominal_feet(config: InSi, robot: RobotParams, name: str) -> tuple[Point, Point]:
    """Contact points (x, z) of front and rear legs from the centre of mass, standing still [m]."""
    own, height = config.gaits[name], gait_setting(config, name, "body_height")
    if own.foothold_front is None or own.foothold_rear is None:
        front, rear = own_body(config.srb, robot, height).feet.tolist()
        return tuple(front), tuple(rear)
    sole = float(robot.foot_radius - height)
    return (own.foothold_front, sole), (-own.foothold_rear, sole)


# A kind of one's own may be another under the same name, in a notebook that loads it again.
@lru_cache(maxsize=32)
def _fit(
    mass: float,
    inertia: float,
    choice: ModelChoice,
    kind: ModelKind,
    seed: int,
    modes: tuple[Mode, ...],
    feet: tuple[tuple[Point, Point], ...],
    heights: tuple[float, ...],
) -> Fits:
    body = stack_bodies(mass, inertia, feet)
    key = jax.random.key(seed)
    with one_blas_thread():
        model, report = jax.device_get(
            _fit_modes(
                body,
                key,
                modes=modes,
                dictionary=choice.dictionary,
                dataset=choice.dataset,
                measured_feet=choice.measured_feet,
            )
        )
    if not report.finite.all():
        raise ValueError("dataset: the EDMD fit is not finite, check its ranges and srb")
    prediction = None
    if kind.params is not None:
        prediction = build_prediction(body, choice, key, modes=modes, heights=heights)
    spread = report.residual_rms if prediction is None else prediction.spread
    return jax.device_get(Fits(model, body.feet, spread, prediction))


def warn_of_fits(config: RunConfig, robot: RobotParams, fits: Fits | None) -> None:
    """Warn of a model that no gait predicts with, and of a linear EDMD model that misleads."""
    if fits is None:
        if config.koopman.model != KoopmanConfig().model:
            warnings.warn(
                f"koopman.model = '{config.koopman.model}' has no effect: controller = 'spatial' "
                "predicts with spatial.model",
                stacklevel=3,
            )
        return
    gaits = build_gaits(config)
    walked = reachable_gaits(config.gaits, config.gait.names)
    uses_cycle = [config.gaits[name].horizon == "multiphase" for name in walked]
    if all(uses_cycle) and config.koopman.model != KoopmanConfig().model:
        warnings.warn(
            f"koopman.model = '{config.koopman.model}' has no effect: {', '.join(walked)} predict "
            "through flight (horizon = 'multiphase') with the rigid body",
            stacklevel=3,
        )
    if get_kind(config.koopman.model).params is not None:
        return
    mass, inertia = (float(number) for number in body_numbers(config, robot))
    bodies = jax.device_get(stack_bodies(mass, inertia, fits.feet))
    duration = config.lmpc.model_dt * config.lmpc.horizon
    for index, (g, mode) in enumerate(contact_problems(gaits, config)[0]):
        if mode == Mode.FLIGHT or gaits[g].name not in walked:
            continue
        model, body = (jax.tree.map(lambda a, i=index: a[i], part) for part in (fits.model, bodies))
        error = force_response_error(
            model,
            body,
            MODE_ALPHA[mode],
            steps=round(duration / config.koopman.dataset.dt),
            duration=duration,
        )
        if error > 1.0:
            warnings.warn(
                f"koopman: over the LMPC's {duration:g} s the velocity that the fitted model of "
                f"{gaits[g].name} ({mode.name.lower()}) predicts for a held force is {error:.1f} "
                "times the rigid body's response away from it, so it may throw the robot over; try "
                "fewer powers (koopman.order), more koopman.dataset.rollouts or another "
                "koopman.dataset.seed",
                stacklevel=3,
            )
