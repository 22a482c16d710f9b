//! The rig: what its numbers say about itself. Reading it has checked each number alone.

use super::AtMost;
use crate::doctor::{Finding, Verdict};
use emberfix_calib::{Eye, Rig};
use emberfix_report::{Bound, Figure};
use std::time::Duration;

/// Rectification of a rig whose eyes look along parallel axes turns them by less than this, degrees;
/// beyond 3 it is not read at all.
const TURN_DEG: AtMost = AtMost {
    good: 1.5,
    usable: 3.0,
};
/// A rig is worth a new look after this many days: mounts creep, lenses are touched.
const OLD_DAYS: f64 = 180.0;
/// |k3| beyond this is a fit that has run away (P4's table).
const MOST_K3: f64 = 1.0;
/// Range at which the rig's own error is told, metres.
const RANGE_M: f64 = 30.0;
/// Error at that range, as a share of it, that the disparity offset may cause.
const RANGE_SHARE: AtMost = AtMost {
    good: 0.15,
    usable: 0.5,
};

/// What the rig says about itself, and how old it is.
#[must_use]
pub fn findings(rig: &Rig, age: Option<Duration>) -> Vec<Finding> {
    let mut findings = vec![shape(rig), range(rig)];
    findings.extend(distortion(rig));
    findings.extend(age.map(old));
    findings
}

fn shape(rig: &Rig) -> Finding {
    let turn_deg = [Eye::Left, Eye::Right]
        .map(|eye| rig.rectification().turn_rad(eye).to_degrees())
        .into_iter()
        .fold(0.0, f64::max);
    let mount = rig.mount();
    let value = format!(
        "{}, baseline {:.1} mm, looks {:.0}\u{b0} down and {:.0}\u{b0} right of the nose, eyes parallel \
         within {turn_deg:.2}\u{b0}",
        rig.name(),
        rig.baseline_m() * 1e3,
        mount.depression_rad.to_degrees(),
        mount.yaw_rad.to_degrees(),
    );
    let remedy = "calibrate the pair again: emberfix calibrate stereo";
    Finding::of(TURN_DEG.judge(turn_deg), "rig", value, remedy)
}

fn range(rig: &Rig) -> Finding {
    let per_px = RANGE_M * RANGE_M / (rig.rectification().focal_px() * rig.baseline_m());
    let error_m = per_px * rig.sigmas().disparity_bias_px;
    let value = format!(
        "at {RANGE_M:.0} m: {error_m:.1} m along the line of sight from the pair, {:.2} m across from \
         the mount (one sigma)",
        RANGE_M * rig.sigmas().boresight_rad,
    );
    let remedy = "stereo alone will be vague at range: calibrate the pair for a smaller \
                  disparity_bias_px, or fly past the fire instead of hovering";
    Finding::of(
        RANGE_SHARE.judge(error_m / RANGE_M),
        "rig accuracy",
        value,
        remedy,
    )
    .with(Figure::bounded(
        "doctor.rig_range_error_30m_m",
        Some(error_m),
        "m",
        Bound::AtMost(RANGE_SHARE.usable * RANGE_M),
        1,
    ))
}

fn distortion(rig: &Rig) -> Option<Finding> {
    let (left, right) = (
        rig.camera(Eye::Left).distortion,
        rig.camera(Eye::Right).distortion,
    );
    let remedy = "calibrate the pair again with the board in every corner of the picture";
    if left == right && left != [0.0; 5] {
        let value = "both eyes have the very same distortion: one was copied from the other";
        return Some(Finding::warn("rig lenses", value, remedy));
    }
    let k3 = left[4].abs().max(right[4].abs());
    (k3 > MOST_K3).then(|| {
        let value = format!("|k3| is {k3:.2}, a lens has less than {MOST_K3}");
        Finding::warn("rig lenses", value, remedy)
    })
}

fn old(age: Duration) -> Finding {
    let days = age.as_secs_f64() / 86_400.0;
    let verdict = if days <= OLD_DAYS {
        Verdict::Pass
    } else {
        Verdict::Warn
    };
    let value = match days {
        days if days < 1.0 => "file written today".to_owned(),
        days => format!("file written {days:.0} days ago"),
    };
    let remedy = "check the calibration: a board before the cameras, or a flight around a surveyed \
                  marker (emberfix calibrate boresight)";
    Finding::of(verdict, "rig age", value, remedy).with(Figure::told(
        "doctor.rig_age_days",
        Some(days),
        "d",
        1,
    ))
}
