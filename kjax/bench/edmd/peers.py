"""Other people's EDMD on given snapshots; ``benchmark.py edmd --peers PYTHON`` runs this.

    PYTHON peers.py                      prints the versions of the peers that are there
    PYTHON peers.py DATA.npz OUT.json    times them

The peers (pykoopman, pykoop) want older versions of NumPy and scikit-learn than kjax does, so they
live in an environment of their own and this file needs nothing of kjax. Each is used as its
documentation has it, with what makes it fast: products in place of powers; in pykoop, sine and
cosine taken once for all observables and the checks of its input off.
"""

import json
import sys
import time
import types
import warnings
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

DT = 1e-3  # s, handed to pykoopman, which keeps it and does not use it
LIMIT = 30.0  # s, after which the loop over many fits is broken off and scaled up
NETWORKS = ("torch", "torch.nn", "torch.nn.utils", "torch.nn.utils.rnn", "torch.utils",
            "torch.utils.data", "lightning")  # fmt: skip


class _Absent(types.ModuleType):
    """A module whose every name is an empty class."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.__path__ = []

    def __getattr__(self, name: str) -> type:
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {})


def import_peers() -> dict[str, Any]:
    """The peers that can be imported, by name.

    pykoopman imports torch and lightning for its neural networks, which nothing here uses: where
    they are not installed, empty modules stand in.
    """
    try:
        import lightning  # noqa: F401
        import torch  # noqa: F401
    except ImportError:
        for name in NETWORKS:
            sys.modules[name] = _Absent(name)
            parent, _, child = name.rpartition(".")
            if parent:
                setattr(sys.modules[parent], child, sys.modules[name])
    found: dict[str, Any] = {}
    builders: tuple[tuple[str, Callable[[], Any]], ...]
    builders = (("pykoopman", Pykoopman), ("pykoop", Pykoop))
    for name, build in builders:
        try:
            version(name)
            found[name] = build()
        except (ImportError, PackageNotFoundError) as error:
            print(f"{name}: {error}", file=sys.stderr)
    return found


# ---------------------------------------------------------------- pykoopman


class Pykoopman:
    """EDMDc with one custom function per observable; all of them take all six states."""

    def __init__(self) -> None:
        import pykoopman
        from pykoopman.observables import CustomObservables
        from pykoopman.regression import EDMDc

        self.Koopman, self.Observables, self.EDMDc = pykoopman.Koopman, CustomObservables, EDMDc

    def pack(self, states: np.ndarray, inputs: np.ndarray) -> tuple[np.ndarray, ...]:
        """Pairs of snapshots in the form that ``fit`` takes."""
        flat = (states[:, :-1], states[:, 1:], inputs)
        return tuple(np.ascontiguousarray(a.reshape(-1, a.shape[-1])) for a in flat)

    def fit(self, data: Any, order: int, constant: bool) -> Any:
        """From states to a fitted model."""
        now, then, inputs = data
        observables = self.Observables(_functions(order, constant))
        model = self.Koopman(observables=observables, regressor=self.EDMDc())
        return model.fit(now, y=then, u=inputs, dt=DT)

    def fit_lifted(self, now: np.ndarray, then: np.ndarray, inputs: np.ndarray) -> Any:
        """The regression alone."""
        return self.EDMDc().fit(now, y=then, u=inputs)

    def predict(self, model: Any, starts: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """States (rollouts, 6) at the end of the rollouts [m, rad, m/s, rad/s]."""
        rows = zip(starts, inputs, strict=True)
        return np.stack([model.simulate(x, u, n_steps=len(u))[-1] for x, u in rows])


def _functions(order: int, constant: bool) -> list[Callable[..., np.ndarray]]:
    """One function per observable behind the six states, which pykoopman puts first itself."""

    # How many arguments a function takes tells pykoopman what to call it with: no defaults here,
    # and no annotations.
    def cosine(power: int) -> Callable[..., np.ndarray]:
        def function(p_x, p_z, theta, v_x, v_z, omega):  # type: ignore[no-untyped-def]
            return _times(np.cos(theta), omega, power)

        return function

    def sine(power: int) -> Callable[..., np.ndarray]:
        def function(p_x, p_z, theta, v_x, v_z, omega):  # type: ignore[no-untyped-def]
            return _times(np.sin(theta), omega, power)

        return function

    def one(p_x, p_z, theta, v_x, v_z, omega):  # type: ignore[no-untyped-def]
        return np.ones_like(theta)

    powers = range(0 if constant else 1, order + 1)
    return [one, *(kind(k) for k in powers for kind in (cosine, sine))]


def _times(value: np.ndarray, omega: np.ndarray, power: int) -> np.ndarray:
    for _ in range(power):
        value = value * omega
    return value


# ---------------------------------------------------------------- pykoop


class Pykoop:
    """Its pipeline with a lifting function of our own, which it asks for whole matrices."""

    def __init__(self) -> None:
        import pykoop

        class Lift(pykoop.EpisodeIndependentLiftingFn):  # type: ignore[misc]
            def __init__(self, order: int = 4, constant: bool = False) -> None:
                self.order, self.constant = order, constant

            def _fit_one_ep(self, X: np.ndarray) -> tuple[int, int]:
                return 7 + 2 * (self.order + self.constant), X.shape[1] - 6

            def _transform_one_ep(self, X: np.ndarray) -> np.ndarray:
                return np.hstack([lift(X[:, :6], self.order, self.constant), X[:, 6:]])

            def _inverse_transform_one_ep(self, X: np.ndarray) -> np.ndarray:
                return np.hstack([X[:, :6], X[:, self.n_states_out_ :]])

            def _validate_parameters(self) -> None:
                pass

            def _transform_feature_names(self, feature_names: Any, format: Any = None) -> Any:
                return feature_names

        self.pykoop, self.Lift = pykoop, Lift
        pykoop.set_config(skip_validation=True)

    def pack(self, states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """Episodes one below the other: number, state, input; the last input counts for nothing."""
        rollouts, rows = states.shape[:2]
        inputs = np.concatenate([inputs, inputs[:, -1:]], axis=1)
        number = np.broadcast_to(np.arange(float(rollouts))[:, None, None], (rollouts, rows, 1))
        return np.concatenate([number, states, inputs], axis=2).reshape(rollouts * rows, -1)

    def fit(self, data: Any, order: int, constant: bool) -> Any:
        """From states to a fitted model."""
        model = self.pykoop.KoopmanPipeline(
            lifting_functions=[("paper", self.Lift(order, constant))],
            regressor=self.pykoop.Edmd(),
        )
        model.fit(data, n_inputs=4, episode_feature=True)
        return model

    def fit_lifted(self, now: np.ndarray, then: np.ndarray, inputs: np.ndarray) -> Any:
        """The regression alone."""
        Z = np.hstack([now, inputs])
        return self.pykoop.Edmd().fit(Z, then, n_inputs=inputs.shape[1], episode_feature=False)

    def predict(self, model: Any, starts: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """States (rollouts, 6) at the end of the rollouts [m, rad, m/s, rad/s]."""
        still = np.repeat(starts[:, None], inputs.shape[1] + 1, axis=1)  # of them the first counts
        path = model.predict_trajectory(self.pack(still, inputs), relift_state=False)
        return path[:, 1:].reshape(len(starts), -1, 6)[:, -1]


def lift(states: np.ndarray, order: int, constant: bool) -> np.ndarray:
    """Observables (M, N) of states (M, 6): the states, 1, then cosine and sine by powers."""
    theta, omega = states[:, 2], states[:, 5]
    pair = np.stack([np.cos(theta), np.sin(theta)], axis=1)
    blocks = [states, np.ones_like(states[:, :1])]
    for power in range(order + 1):
        if power or constant:
            blocks.append(pair)
        if power < order:
            pair = pair * omega[:, None]
    return np.hstack(blocks)


def columns(order: int, constant: bool) -> np.ndarray:
    """Columns of ``lift(states, order or more, True)`` that make up a smaller dictionary."""
    first = 7 if constant else 9
    return np.r_[:7, first : 9 + 2 * order]


# ---------------------------------------------------------------- timing


def main() -> None:
    """Print versions, or time the peers on a file of data."""
    warnings.simplefilter("ignore")
    peers = import_peers()
    if len(sys.argv) == 1:
        print(json.dumps({name: version(name) for name in peers}))
        return
    with np.load(sys.argv[1]) as read:
        data = dict(read)
    with open(sys.argv[2], "w", encoding="utf-8") as file:
        json.dump(measure(peers, data), file)


def measure(peers: Mapping[str, Any], data: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Per peer: times of single fits and of the regression alone, of all fits, predictions.

    Args:
      peers: as of ``import_peers``.
      data: states (seeds, rollouts, steps + 1, 6) and inputs (seeds, rollouts, steps, 4) to fit,
        test_states and test_inputs to predict, dictionaries (D, 2) as (order, constant) with the
        one of the single fit first, and the number of calls.

    Returns:
      ``fit_ms`` and ``regression_ms`` of every call; ``end`` (rollouts, 6), predicted; and what
      ``many`` returns, with ``many_done``, how many of its fits were timed.
    """
    states, inputs = data["states"], data["inputs"]
    dictionaries = [(int(order), bool(constant)) for order, constant in data["dictionaries"]]
    single, calls = dictionaries[0], int(data["calls"])
    now, then = (
        np.ascontiguousarray(s).reshape(len(states), -1, 6)
        for s in (states[:, :, :-1], states[:, :, 1:])
    )
    forces = inputs.reshape(len(states), -1, 4)
    lifted = [lift(a[0], *single) for a in (now, then)]
    packed = {name: [p.pack(*d) for d in zip(states, inputs, strict=True)]
              for name, p in peers.items()}  # fmt: skip
    result: dict[str, Any] = {name: {"fit_ms": [], "regression_ms": []} for name in peers}
    for call in range(calls + 1):  # the first one warms up
        for name, peer in peers.items():
            clock = time.perf_counter()
            model = peer.fit(packed[name][0], *single)
            middle = time.perf_counter()
            peer.fit_lifted(*lifted, forces[0])
            if call:
                result[name]["fit_ms"].append(1e3 * (middle - clock))
                result[name]["regression_ms"].append(1e3 * (time.perf_counter() - middle))
                continue
            end = peer.predict(model, data["test_states"][:, 0], data["test_inputs"])
            result[name]["end"] = end.tolist()
    for name, peer in peers.items():
        result[name] |= many(peer, packed[name], now, then, forces, dictionaries)
    return result


def many(
    peer: Any,
    packed: Sequence[Any],
    now: np.ndarray,
    then: np.ndarray,
    forces: np.ndarray,
    dictionaries: Sequence[tuple[int, bool]],
) -> dict[str, Any]:
    """Time of fits of every data set in every dictionary, and of the same from lifted states [s].

    For the latter, a data set is lifted once, in the largest dictionary, and columns are cut out:
    what a careful user would do.
    """
    places = [(seed, chosen) for seed in range(len(packed)) for chosen in dictionaries]
    full, done = _loop(lambda seed, chosen: peer.fit(packed[seed], *chosen), places)
    order = max(order for order, _ in dictionaries)
    clock = time.perf_counter()
    large = [[lift(a, order, True) for a in pair] for pair in zip(now, then, strict=True)]
    lifting = time.perf_counter() - clock

    def from_lifted(seed: int, chosen: tuple[int, bool]) -> None:
        use = columns(*chosen)
        peer.fit_lifted(*(part[:, use] for part in large[seed]), forces[seed])

    cut, _ = _loop(from_lifted, places)
    return {"many_s": full, "many_lifted_s": lifting + cut, "many_done": done}


def _loop(call: Callable[..., Any], places: Sequence[tuple[int, Any]]) -> tuple[float, int]:
    """Time of a call at all places [s], if need be by proportion, and how many were timed."""
    clock, spent, done = time.perf_counter(), 0.0, 0
    while done < len(places) and spent < LIMIT:
        call(*places[done])
        spent = time.perf_counter() - clock
        done += 1
    return spent * len(places) / done, done


if __name__ == "__main__":
    main()
