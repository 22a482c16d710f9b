//! What the tests of several rooms start from.

use crate::pose::Pose;
use emberfix_calib::Rig;
use emberfix_frames::{Attitude, EllipsoidHeight, ServiceTime, Vector3, Wgs84, place_from_degrees};
use std::collections::BTreeSet;

/// A rig without distortion, tilt or lever arm, so that vectors can be written by hand.
pub fn rig(depression_deg: f64) -> Rig {
    let camera = "image_size_px = [1280, 720]\nfocal_px = [880.0, 880.0]\n\
                  principal_point_px = [640.0, 360.0]\ndistortion = [0.0, 0.0, 0.0, 0.0, 0.0]\n";
    let text = format!(
        "name = \"plain\"\n[left]\n{camera}[right]\n{camera}[stereo]\n\
         right_from_left_rotation_deg = [0.0, 0.0, 0.0]\n\
         right_from_left_translation_m = [-0.075, 0.0, 0.0]\nmax_skew_s = 0.001\n\
         [mount]\nyaw_deg = 0.0\ndepression_deg = {depression_deg:?}\nroll_deg = 0.0\n\
         lever_arm_m = [0.0, 0.0, 0.0]\n[time]\ncamera_offset_s = 0.0\n[sigma]\n\
         disparity_bias_px = 0.1\nboresight_deg = 0.3\nlever_arm_m = 0.02\ntime_offset_s = 0.005\n"
    );
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), text).unwrap();
    Rig::load(file.path()).unwrap()
}

/// P3's fire.
pub fn datum() -> Wgs84 {
    let (latitude, longitude) = (31.409_422_2, 119.112_016_7);
    place_from_degrees(latitude, longitude, EllipsoidHeight::from_m(8.7067)).unwrap()
}

/// At the datum, moving and turning.
pub fn pose(roll: f64, pitch: f64, heading: f64) -> Pose {
    Pose {
        at: ServiceTime::from_unix_ns(0),
        place: datum(),
        attitude: Attitude::from_angles(roll, pitch, heading),
        velocity_enu_m_s: Vector3::new(3.0, -4.0, 0.5),
        rate_rad_s: Vector3::new(0.1, -0.05, 0.2),
        gnss_horizontal_m: 1.5,
        gnss_vertical_m: 2.5,
        attitude_noise_rad: 0.002,
        position_noise_m: 0.05,
        time_sigma_s: 0.002,
        degraded: BTreeSet::new(),
    }
}
