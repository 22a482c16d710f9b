//! How the camera sits on the airframe and how late its clock is, from a flight past one fixed point.
//!
//! **Purpose.** One batch of nonlinear least squares over what a flight does not change: camera-to-body
//! rotation, lever arm, clock offset of the camera, heading and tilt error of the autopilot, GNSS offset,
//! place of the marker. **In:** [`Sight`]s (pixels of the raw left image, and the way that the airframe
//! took about that moment, in the plane at the mission datum), a [`Start`] with the rig as it is and what
//! is known beforehand. **Out:** a [`Solution`]: every parameter with its sigma, the covariance of all, and
//! `words` that say what the flight could not show and what to fly instead. `solve`, `model`, `wander` and
//! `words` are pure; `flight` reads recordings, `rig_file` writes rigs.
//!
//! **Method.** Gauss-Newton with Levenberg's damping on the projection of the marker, Cauchy weights
//! against wrong picks, several starts over the clock. Heading, tilt and GNSS wander while the flight goes
//! on, and are solved for as processes (`wander`). Where residuals of neighbouring pictures still resemble
//! each other the covariance is widened, so that more pictures a second do not make it smaller than it is.
//!
//! **Assumptions.** The marker stands still; the autopilot's errors wander as the mission says.
//! **Known limits.** What cannot be told apart stays open, and is said: the mount's yaw from the heading's
//! error, the lever arm from a GNSS offset in body axes, a GNSS offset without a surveyed marker.

mod flight;
mod model;
pub mod rig_file;
mod solve;
#[cfg(test)]
mod tests;
mod wander;
mod words;

pub use flight::{Gathered, Marker, Picker, Picks, PicksError, gather};
pub(crate) use model::mount_of;
pub use model::{BodyAt, Parameter, Sight, Start, Stereo, Way};
pub use solve::{Ranges, Solution, SolveError, solve};
pub use wander::Wandering;
pub use words::observability;
