//! emberfix: finds fire from a UAV's stereo camera and tells the ground where it is, and how sure.
//!
//! Data goes one way: [`ingest`] and MAVLink feed [`pose`], [`detect`], [`range`]; [`locate`] turns
//! a sighting into a fix, [`track`] fixes into fires, [`alarm`] fires into decisions; [`deliver`]
//! takes alarms to the ground, where [`ground`] keeps and shows them; [`record`] writes it all down.
//!
//! Absences, which a test checks:
//! - `locate`, `track`, `alarm`, `assess` do no I/O and read no clock; time and seeds are arguments.
//! - `detect` is the only user of ONNX Runtime, `range` the only stereo use of OpenCV.
//! - Nothing that flies knows the simulator, which reaches the service as a stranger would; [`eval`]
//!   alone uses its world, as truth to measure against.

pub mod alarm;
pub mod assess;
pub mod boresight;
pub mod cli;
pub mod deliver;
pub mod detect;
pub mod doctor;
pub mod eval;
pub mod ground;
pub mod ingest;
pub mod locate;
pub mod mission;
pub mod pipeline;
pub mod pose;
pub mod range;
pub mod record;
pub mod replay;
pub mod service;
pub mod terrain;
pub mod track;

#[cfg(test)]
mod testing;
