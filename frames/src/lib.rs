//! Frames, heights, clocks, covariance, and the conversions between them.
//!
//! **Purpose.** Every other room states *in which frame*, *above which surface* and *by which
//! clock* a number holds, with the types of this crate. It is the only place that asserts how two
//! frames relate; each assertion stands once and says why it holds.
//!
//! **In and out.** Metres, radians and seconds as `f64`; degrees only in names that end in `_deg`.
//!
//! **Assumptions.** WGS84 for the Earth, EGM96 for mean sea level, UTC without leap seconds for
//! [`ServiceTime`].
//!
//! **Known limits.** Types keep frames apart, not *directions*: a rotation that was built inverted
//! compiles. Hence every rotation here is tested against a known heading.
//!
//! Frames do not mix:
//!
//! ```compile_fail
//! use emberfix_frames::{CamLeft, BodyFrd, Coordinate, Metres, Vector3};
//! let in_camera = Coordinate::<CamLeft>::from_metres(Vector3::new(0.0, 0.0, 10.0));
//! let in_body: Coordinate<BodyFrd> = in_camera; // not without the mount
//! ```
//! ```
//! use emberfix_frames::{body_from_camera, CamLeft, BodyFrd, Coordinate, Metres, MountAngles, Vector3};
//! let in_camera = Coordinate::<CamLeft>::from_metres(Vector3::new(0.0, 0.0, 10.0));
//! let in_body: Coordinate<BodyFrd> =
//!     body_from_camera::<CamLeft>(MountAngles::default()).transform(in_camera);
//! # assert!((in_body.metres().x - 10.0).abs() < 1e-12);
//! ```
//!
//! Heights do not mix:
//!
//! ```compile_fail
//! use emberfix_frames::{EllipsoidHeight, MslAltitude};
//! let height: EllipsoidHeight = MslAltitude::from_m(12.0); // not without a geoid
//! ```
//! ```
//! use emberfix_frames::{EllipsoidHeight, GeoidUndulation, MslAltitude};
//! let height: EllipsoidHeight = MslAltitude::from_m(12.0) + GeoidUndulation::from_m(10.5);
//! # assert_eq!(height.m(), 22.5);
//! ```
//!
//! Clocks do not mix:
//!
//! ```compile_fail
//! use emberfix_frames::{BootTime, ServiceTime};
//! let lag = ServiceTime::from_unix_ns(5) - BootTime::from_ns(3); // not without TimeSync
//! ```
//! ```
//! use emberfix_frames::ServiceTime;
//! let lag = ServiceTime::from_unix_ns(5) - ServiceTime::from_unix_ns(3);
//! # assert_eq!(lag.as_nanos(), 2);
//! ```

mod attitude;
mod clocks;
mod covariance;
mod earth;
mod geoid;
mod heights;
mod metres;
mod mount;
mod systems;
mod timesync;

pub use attitude::{Attitude, AttitudeError};
pub use clocks::{BootTime, ServiceTime, SignedDuration, Stamped, seconds};
pub use covariance::{Covariance, CovarianceError};
pub use earth::{
    PlaceError, Wgs84Parts, ecef_from_enu, enu_from_ecef, enu_offset, place_from_degrees,
    place_from_ecef, rotation_matrix,
};
pub use geoid::Geoid;
pub use heights::{EllipsoidHeight, GeoidUndulation, HeightAboveGround, MslAltitude};
pub use metres::Metres;
pub use mount::{MountAngles, body_from_camera, raw_from_rectified};
pub use nalgebra::{Matrix3, UnitQuaternion, Vector2, Vector3};
pub use sguaba::Coordinate;
pub use sguaba::Vector;
pub use sguaba::math::{RigidBodyTransform, Rotation};
pub use sguaba::systems::{Ecef, Wgs84};
pub use systems::{BodyFrd, CamLeft, CamLeftRaw, MissionEnu, VehicleEnu, VehicleNed};
pub use timesync::{SyncQuality, TimeSync, TimeSyncSample};
