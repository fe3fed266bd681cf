"""What the controller remembers from call to call, and what a plan tells of itself."""

from typing import NamedTuple

from jaxtyping import Array, Bool, Float, Int

from kjax import gait
from kjax.legs.contact import ContactState
from kjax.legs.ground import GroundSlope
from kjax.legs.swing import SwingState
from kjax.mpc.lmpc import LmpcMemory
from kjax.mpc.momentum import MomentumMemory


class ControllerState(NamedTuple):
    """What the controller remembers between calls; nothing in it depends on where zero is.

    Points are in the *local* frame: origin at the trunk's, axes of the world (planar base) or of
    the track frame of ``legs.spatial`` (free base). They are carried along by the trunk's velocity,
    so that no position estimate enters.

    Attributes:
      time: since ``init`` [s].
      clock: gait, phase and time in it.
      stance: (4,) scheduled stance legs.
      lag: (2,) reference of the place less the place, the velocity's error integrated, bounded;
        ahead and 0 in the planar controller, local axes in the spatial one [m].
      heading: reference of the yaw since ``init``; 0 in the planar controller [rad].
      command: (6,) in force now, order of ``types.COMMAND_NAMES``.
      height: reference of the height above the gait's own, which follows the command at a bounded
        rate [m].
      ground: height of the ground under the last stance feet, local frame; where it slopes, below
        the trunk [m].
      slope: of the ground, from the last footholds; ``None`` in the planar controller.
      velocity: (3,) references of v_x, v_y and yaw rate, which follow the command at bounded rates;
        the planar controller's has v_x alone [m/s, m/s, rad/s].
      correction: integrals of errors, added to their references: of velocity and pitch in the
        planar controller [m/s, rad], of v_x, v_y and heading in the spatial one [m/s, m/s, rad].
      memory: of the LMPC: its last plan and where the QP goes on from.
      force: (4, 3) force that each leg shall put on the robot, local axes; it holds in them until
        the next plan [N].
      swing: state of the swing legs, local frame.
      feet: (4, d) foot centres in the last valid sample, local frame [m].
      base_vel: (d,) velocity of the trunk in that sample, local axes [m/s].
      torque: (4, 3) last torque of a valid sample [N m].
      blind_time: time without a valid sample [s].
      contact: what is made of the contact flags.
      track: (2,) cosine and sine of the heading to keep, the trunk's at ``init``, world [-];
        ``None`` on the planar base.
    """

    time: Float[Array, ""]
    clock: gait.Clock
    stance: Bool[Array, "4"]
    lag: Float[Array, "2"]
    heading: Float[Array, ""]
    command: Float[Array, "6"]
    height: Float[Array, ""]
    ground: Float[Array, ""]
    slope: GroundSlope | None
    velocity: Float[Array, "3"]
    correction: Float[Array, "c"]
    memory: LmpcMemory | MomentumMemory
    force: Float[Array, "4 3"]
    swing: SwingState
    feet: Float[Array, "4 d"]
    base_vel: Float[Array, "d"]
    torque: Float[Array, "4 3"]
    blind_time: Float[Array, ""]
    contact: ContactState
    track: Float[Array, "2"] | None


class PlanInfo(NamedTuple):
    """What a plan did; for logs and for callers that must know.

    Attributes:
      status: a ``qp.Status``. At the iteration limit the solver's last point is in force; with
        faulty data the shifted last plan is.
      residual: relative KKT residual of the solver's point [-].
      iterations: of the solver.
      mode: contact mode.
      x: (n_x,) state of the prediction as estimated from the observation; p_x and p_z from the
        ground below the centre of mass [m, rad, m/s, rad/s].
      reference: (n_x,) state wanted one model step ahead, likewise.
      contact_fault: (4,) legs whose contact flag keeps contradicting their kinematics.
      command_ignored: whether the command asks for what this controller does not follow.
      blind_time: time without a valid sample, this one included [s].
    """

    status: Int[Array, ""]
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    mode: Int[Array, ""]
    x: Float[Array, "n_x"]
    reference: Float[Array, "n_x"]
    contact_fault: Bool[Array, "4"]
    command_ignored: Bool[Array, ""]
    blind_time: Float[Array, ""]
