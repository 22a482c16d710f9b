//! The `[gimbal]` table: the gimbal that carries the rig. Without the table the rig is fixed to the
//! airframe.

use crate::pose::GimbalConfig;
use emberfix_calib::Checks;
use emberfix_frames::Vector3;
use emberfix_mav::ComponentId;
use serde::Deserialize;

#[derive(Deserialize)]
pub(super) struct RawGimbal {
    pivot_m: [f64; 3],
    component_id: Option<u8>,
    #[serde(default)]
    device_id: u8,
    sigma_deg: Option<f64>,
}

/// How well a gimbal knows how it stands, one sigma.
const SIGMA_DEG: f64 = 0.5;

impl RawGimbal {
    pub(super) fn check(&self, checks: &mut Checks) {
        for (axis, value) in ["forward", "right", "down"].iter().zip(self.pivot_m) {
            let key = format!("gimbal.pivot_m ({axis})");
            checks.range(&key, value, -20.0, 20.0, " (metres)");
        }
        checks.range(
            "gimbal.device_id",
            f64::from(self.device_id),
            0.0,
            6.0,
            " (0 is the component itself)",
        );
        checks.range(
            "gimbal.sigma_deg",
            self.sigma_deg.unwrap_or(SIGMA_DEG),
            0.01,
            45.0,
            " (degrees)",
        );
    }

    pub(super) fn build(&self) -> GimbalConfig {
        GimbalConfig {
            pivot_m: Vector3::from(self.pivot_m),
            component: self.component_id.map(ComponentId),
            device: self.device_id,
        }
    }

    pub(super) fn sigma_rad(&self) -> f64 {
        self.sigma_deg.unwrap_or(SIGMA_DEG).to_radians()
    }
}
