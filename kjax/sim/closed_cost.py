"""The cost of ``kjax.tuning`` for what MuJoCo did, so that both are compared on the same scale."""

import numpy as np

from kjax.robots import get_robot
from kjax.sim.metrics import reference_height
from kjax.sim.recording import Recording
from kjax.tuning.loop import CostWeights, Trace, cost


def recording_costs(
    recording: Recording,
    weights: CostWeights = CostWeights(),  # noqa: B008
) -> np.ndarray:
    """Cost (B,) of every robot of a batch; ticks after its fall count as fallen.

    Planned forces stand for those on the body: what joints or ground keep back of them shows in the
    motion only.
    """
    log, ticks = recording.log, len(recording.qpos)
    out = []
    for robot, episode in enumerate(recording.episodes):
        height = reference_height(log.gait[:, robot], recording.dt * np.arange(ticks), episode.goal)
        force = np.asarray(log.force[:, robot])[..., ::2]
        trace = Trace(
            x=log.x[:, robot],
            wanted=np.stack([log.velocity_reference[:, robot], height], axis=1),  # type: ignore[arg-type]
            feet=log.feet[:, robot],
            stance=log.stance[:, robot],
            mode=log.gait[:, robot],
            force=force,  # type: ignore[arg-type]
            missing=np.zeros_like(force),  # type: ignore[arg-type]
            status=log.status[:, robot],
            alive=np.arange(ticks) < recording.ticks[robot] - recording.fell[robot],
        )
        out.append(float(cost(get_robot(episode.goal.scene.robot).params, trace, weights)))
    return np.array(out)
