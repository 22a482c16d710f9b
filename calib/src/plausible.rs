//! The gate that says no: what a rig's numbers say of a calibration that went wrong.

use crate::{Camera, Eye, Rectification};
use emberfix_frames::Vector3;

/// How bad it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Severity {
    /// May be flown; the operator should know.
    Doubt,
    /// Must not be flown.
    Refusal,
}

/// One thing that is wrong: the figure, what is allowed, what to do.
#[derive(Debug, Clone, PartialEq)]
pub struct Finding {
    /// How bad.
    pub severity: Severity,
    /// One sentence.
    pub sentence: String,
}

impl Finding {
    /// Must not be flown.
    #[must_use]
    pub fn refusal(sentence: String) -> Self {
        Self {
            severity: Severity::Refusal,
            sentence,
        }
    }

    /// The operator should know.
    #[must_use]
    pub fn doubt(sentence: String) -> Self {
        Self {
            severity: Severity::Doubt,
            sentence,
        }
    }
}

impl std::fmt::Display for Finding {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.sentence)
    }
}

/// Beyond this a rig is bent or its calibration wrong (P4's printed rig turns by 6.9 degrees).
pub const MAX_TURN_DEG: f64 = 3.0;
/// A third radial term beyond this fits noise (P4 prints 3.63).
pub const MAX_K3: f64 = 1.0;
/// Two lenses differ by more than this in some term (P4's two cameras agree to 1e-4).
const SAME_DISTORTION: f64 = 1e-3;
/// The focal lengths of two eyes that see the same scene.
const FOCAL_RATIO: f64 = 1.25;

/// What is implausible about two cameras and the way between them.
#[must_use]
pub fn implausible(
    left: &Camera,
    right: &Camera,
    rectification: &Rectification,
    translation_m: &Vector3<f64>,
) -> Vec<Finding> {
    let mut findings = Vec::new();
    findings.extend(too_much_turn(rectification, translation_m));
    for (eye, camera) in [("left", left), ("right", right)] {
        findings.extend(over_fit(eye, camera));
        findings.extend(folded(eye, camera));
    }
    findings.extend(same_lens(left, right));
    findings.extend(unlike_focal_lengths(left, right));
    findings
}

fn too_much_turn(rectification: &Rectification, translation_m: &Vector3<f64>) -> Option<Finding> {
    let turned_deg = [Eye::Left, Eye::Right]
        .map(|eye| rectification.turn_rad(eye).to_degrees())
        .into_iter()
        .fold(0.0, f64::max);
    let along_mm = 1e3 * translation_m.z;
    (turned_deg > MAX_TURN_DEG).then(|| {
        Finding::refusal(format!(
            "rectification turns an eye by {turned_deg:.1} degrees, allowed is {MAX_TURN_DEG} (one eye \
             stands {along_mm:.1} mm ahead of the other); calibrate again with more tilted boards: a rig \
             whose eyes look along parallel axes needs less than one"
        ))
    })
}

fn over_fit(eye: &str, camera: &Camera) -> Option<Finding> {
    let k3 = camera.distortion[4];
    (k3.abs() > MAX_K3).then(|| {
        Finding::doubt(format!(
            "{eye}.distortion k3 is {k3}, believable is -{MAX_K3} to {MAX_K3}: it fits noise where no \
             corner was; calibrate again with boards in the image's corners"
        ))
    })
}

/// A radial distortion that turns back inside the image maps two rays to one pixel.
fn folded(eye: &str, camera: &Camera) -> Option<Finding> {
    let [k1, k2, _, _, k3] = camera.distortion;
    let farthest = farthest_radius(camera);
    let turns_back = (1..=200)
        .map(|step| farthest * f64::from(step) / 200.0)
        .find(|r| {
            let r2 = r * r;
            1.0 + r2 * (3.0 * k1 + r2 * (5.0 * k2 + r2 * 7.0 * k3)) <= 0.0
        })?;
    let angle_deg = turns_back.atan().to_degrees();
    Some(Finding::doubt(format!(
        "{eye}.distortion folds the image over at {angle_deg:.0} degrees from the boresight, inside \
         the picture; calibrate again with boards in the image's corners"
    )))
}

/// Tangent of the angle to the image corner that is farthest from the boresight, undistorted roughly.
fn farthest_radius(camera: &Camera) -> f64 {
    let (width, height) = camera.image_size_px;
    let (cx, cy) = camera.principal_point_px;
    let across = cx.max(f64::from(width) - cx) / camera.focal_px.0;
    let down = cy.max(f64::from(height) - cy) / camera.focal_px.1;
    across.hypot(down)
}

fn same_lens(left: &Camera, right: &Camera) -> Option<Finding> {
    let none = left.distortion.iter().all(|term| *term == 0.0);
    let apart = left
        .distortion
        .iter()
        .zip(&right.distortion)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f64::max);
    (!none && apart < SAME_DISTORTION).then(|| {
        Finding::doubt(format!(
            "left.distortion and right.distortion agree to {apart:.0e}, two lenses never agree to \
             {SAME_DISTORTION}: one camera's numbers were used for both; calibrate each eye"
        ))
    })
}

fn unlike_focal_lengths(left: &Camera, right: &Camera) -> Option<Finding> {
    let ratio = left.focal_px.0 / right.focal_px.0;
    (!(1.0 / FOCAL_RATIO..=FOCAL_RATIO).contains(&ratio)).then(|| {
        Finding::doubt(format!(
            "left.focal_px is {ratio:.2} times right.focal_px, believable is up to {FOCAL_RATIO}: were \
             the eyes calibrated at different image sizes?"
        ))
    })
}
