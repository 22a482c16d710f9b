//! A rig in parts, as it is put together by calibration, import and hand; and as a rig file.

use crate::{Camera, Rig, RigError, RigSigmas, file};
use emberfix_frames::{
    CamLeftRaw, Matrix3, Metres, MountAngles, UnitQuaternion, Vector3, body_from_camera,
    rotation_matrix,
};
use std::fmt::Write as _;
use std::path::Path;

/// How the left camera stands on the airframe, what its clock is worth, and which light the right eye
/// sees: no picture tells.
#[derive(Debug, Clone, PartialEq)]
pub struct Mounting {
    /// Boresight on the airframe.
    pub angles: MountAngles,
    /// Body origin to the left camera's centre: forward, right, down, metres.
    pub lever_arm_m: Vector3<f64>,
    /// Autopilot time = camera time + this, seconds.
    pub time_offset_s: f64,
    /// One sigma of the boresight, radians per axis.
    pub boresight_sigma_rad: f64,
    /// One sigma of the lever arm, metres per axis.
    pub lever_arm_sigma_m: f64,
    /// One sigma of the time offset, seconds.
    pub time_offset_sigma_s: f64,
    /// The right eye sees near infrared, the left one colour.
    pub right_near_infrared: bool,
}

impl Mounting {
    /// That of a rig.
    #[must_use]
    pub fn of(rig: &Rig) -> Self {
        Self {
            angles: rig.mount(),
            lever_arm_m: rig.lever_arm().metres(),
            time_offset_s: rig.time_offset_s(),
            boresight_sigma_rad: rig.sigmas().boresight_rad,
            lever_arm_sigma_m: rig.sigmas().lever_arm_m,
            time_offset_sigma_s: rig.sigmas().time_offset_s,
            right_near_infrared: rig.right_near_infrared(),
        }
    }
}

/// What a calibration says of itself; stands in the rig file's `[calibrated]`.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibrated {
    /// When, UTC, RFC 3339.
    pub at: String,
    /// Pairs of pictures that were used.
    pub pairs: usize,
    /// Root mean square reprojection error of the fit, pixels.
    pub rms_px: f64,
    /// The same on pairs that were held out, pixels.
    pub held_out_rms_px: f64,
    /// One sigma of a depth at 10 m that comes from the calibration, per cent.
    pub range_sigma_at_10m_percent: f64,
}

/// Everything that a rig file holds; [`Self::check`] makes a [`Rig`] of it.
#[derive(Debug, Clone, PartialEq)]
pub struct RigParts {
    /// Name, for reports.
    pub name: String,
    /// Left camera.
    pub left: Camera,
    /// Right camera.
    pub right: Camera,
    /// Takes left-camera components to right-camera components (OpenCV's R).
    pub right_from_left: Matrix3<f64>,
    /// Left camera's origin in right-camera components, metres (OpenCV's T).
    pub translation_m: Vector3<f64>,
    /// Greatest difference of exposures that is one moment, seconds.
    pub max_skew_s: f64,
    /// One sigma of the disparity offset, pixels.
    pub disparity_bias_px: f64,
    /// On the airframe.
    pub mounting: Mounting,
    /// Where it comes from, if a calibration said so.
    pub calibrated: Option<Calibrated>,
}

impl RigParts {
    /// Those of a rig.
    #[must_use]
    pub fn of(rig: &Rig) -> Self {
        Self {
            name: rig.name().to_owned(),
            left: rig.camera(crate::Eye::Left).clone(),
            right: rig.camera(crate::Eye::Right).clone(),
            right_from_left: *rig.right_from_left(),
            translation_m: *rig.right_from_left_translation_m(),
            max_skew_s: rig.max_skew_s(),
            disparity_bias_px: rig.sigmas().disparity_bias_px,
            mounting: Mounting::of(rig),
            calibrated: rig.calibrated().cloned(),
        }
    }

    /// The sigmas as a rig has them.
    #[must_use]
    pub fn sigmas(&self) -> RigSigmas {
        RigSigmas {
            disparity_bias_px: self.disparity_bias_px,
            boresight_rad: self.mounting.boresight_sigma_rad,
            lever_arm_m: self.mounting.lever_arm_sigma_m,
            time_offset_s: self.mounting.time_offset_sigma_s,
        }
    }

    /// Holds the parts to everything that a rig file is held to; `path` is named in what is refused.
    ///
    /// # Errors
    /// [`RigError`].
    pub fn check(&self, path: &Path) -> Result<Rig, RigError> {
        file::parse(&self.to_toml(), path)
    }

    /// The rig file.
    #[must_use]
    pub fn to_toml(&self) -> String {
        let mut text = format!("name = {}\n", toml::Value::from(self.name.as_str()));
        for (eye, camera) in [("left", &self.left), ("right", &self.right)] {
            write_camera(&mut text, eye, camera);
        }
        if self.mounting.right_near_infrared {
            // Still in the right eye's table.
            text.push_str("near_infrared = true\n");
        }
        self.write_pair(&mut text);
        self.write_mounting(&mut text);
        if let Some(calibrated) = &self.calibrated {
            write_calibrated(&mut text, calibrated);
        }
        text
    }

    fn write_pair(&self, text: &mut String) {
        let turn_deg = UnitQuaternion::from_matrix(&self.right_from_left)
            .scaled_axis()
            .map(f64::to_degrees);
        let lines = [
            ("right_from_left_rotation_deg", list(turn_deg.as_slice())),
            (
                "right_from_left_translation_m",
                list(self.translation_m.as_slice()),
            ),
            ("max_skew_s", number(self.max_skew_s)),
        ];
        write_table(text, "stereo", &lines);
    }

    fn write_mounting(&self, text: &mut String) {
        let mount = &self.mounting;
        let degrees = |rad: f64| number(rad.to_degrees());
        let lines = [
            ("yaw_deg", degrees(mount.angles.yaw_rad)),
            ("depression_deg", degrees(mount.angles.depression_rad)),
            ("roll_deg", degrees(mount.angles.roll_rad)),
            ("lever_arm_m", list(mount.lever_arm_m.as_slice())),
        ];
        write_table(text, "mount", &lines);
        let offset = [("camera_offset_s", number(mount.time_offset_s))];
        write_table(text, "time", &offset);
        let sigmas = [
            ("disparity_bias_px", number(self.disparity_bias_px)),
            ("boresight_deg", degrees(mount.boresight_sigma_rad)),
            ("lever_arm_m", number(mount.lever_arm_sigma_m)),
            ("time_offset_s", number(mount.time_offset_sigma_s)),
        ];
        write_table(text, "sigma", &sigmas);
    }
}

fn write_camera(text: &mut String, eye: &str, camera: &Camera) {
    let (width, height) = camera.image_size_px;
    let lines = [
        ("image_size_px", format!("[{width}, {height}]")),
        ("focal_px", list(&[camera.focal_px.0, camera.focal_px.1])),
        (
            "principal_point_px",
            list(&[camera.principal_point_px.0, camera.principal_point_px.1]),
        ),
        ("distortion", list(&camera.distortion)),
    ];
    write_table(text, eye, &lines);
}

fn write_calibrated(text: &mut String, calibrated: &Calibrated) {
    let lines = [
        ("at", toml::Value::from(calibrated.at.as_str()).to_string()),
        ("pairs", calibrated.pairs.to_string()),
        ("rms_px", number(calibrated.rms_px)),
        ("held_out_rms_px", number(calibrated.held_out_rms_px)),
        (
            "range_sigma_at_10m_percent",
            number(calibrated.range_sigma_at_10m_percent),
        ),
    ];
    write_table(text, "calibrated", &lines);
}

fn write_table(text: &mut String, name: &str, lines: &[(&str, String)]) {
    // Writing to a String does not fail.
    let _ = writeln!(text, "\n[{name}]");
    for (key, value) in lines {
        let _ = writeln!(text, "{key} = {value}");
    }
}

/// Every bit, as TOML wants it: with a point or an exponent.
fn number(value: f64) -> String {
    toml::Value::from(value).to_string()
}

fn list(values: &[f64]) -> String {
    let values: Vec<String> = values.iter().map(|value| number(*value)).collect();
    format!("[{}]", values.join(", "))
}

/// The mount's angles of the rotation that takes left-camera to body components (FRD).
#[must_use]
pub fn mount_angles(body_from_camera_raw: &Matrix3<f64>) -> MountAngles {
    let boresight = body_from_camera_raw.column(2);
    let straight = MountAngles {
        yaw_rad: boresight.y.atan2(boresight.x),
        depression_rad: boresight.z.clamp(-1.0, 1.0).asin(),
        roll_rad: 0.0,
    };
    let without_roll = rotation_matrix(&body_from_camera::<CamLeftRaw>(straight));
    let rolled = without_roll.transpose() * body_from_camera_raw;
    MountAngles {
        roll_rad: rolled[(1, 0)].atan2(rolled[(0, 0)]),
        ..straight
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mount_angles_are_found_again() {
        for (yaw, depression, roll) in [
            (0.0, 0.0, 0.0),
            (0.1, 0.5, -0.2),
            (-2.0, -0.3, 1.4),
            (3.0, 1.2, -3.0),
        ] {
            let angles = MountAngles {
                yaw_rad: yaw,
                depression_rad: depression,
                roll_rad: roll,
            };
            let matrix = rotation_matrix(&body_from_camera::<CamLeftRaw>(angles));
            let found = mount_angles(&matrix);
            assert!((found.yaw_rad - yaw).abs() < 1e-12, "{found:?}");
            assert!((found.depression_rad - depression).abs() < 1e-12);
            assert!((found.roll_rad - roll).abs() < 1e-12, "{found:?}");
        }
    }

    #[test]
    fn a_rig_file_written_and_read_again_is_the_same_rig() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs/oakd-75mm.toml");
        let mut parts = RigParts::of(&Rig::load(&path).unwrap());
        parts.calibrated = Some(Calibrated {
            at: "2026-03-01T04:00:10Z".to_owned(),
            pairs: 29,
            rms_px: 0.2,
            held_out_rms_px: 0.25,
            range_sigma_at_10m_percent: 0.2,
        });
        assert!(!parts.mounting.right_near_infrared);
        parts.mounting.right_near_infrared = true;
        let again = RigParts::of(&parts.check(Path::new("again.toml")).unwrap());
        assert!(again.mounting.right_near_infrared);
        assert_eq!(again.left, parts.left);
        assert_eq!(again.right, parts.right);
        assert_eq!(again.calibrated, parts.calibrated);
        assert_eq!(again.translation_m, parts.translation_m);
        // Degrees and back cost the last bits of an angle.
        assert!((again.right_from_left - parts.right_from_left).norm() < 1e-14);
        let angles = (again.mounting.angles, parts.mounting.angles);
        assert!((angles.0.depression_rad - angles.1.depression_rad).abs() < 1e-14);
    }
}
