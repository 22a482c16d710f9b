//! A second detector on a right eye that sees another spectrum, and what both eyes say together.

use super::Counters;
use crate::detect::fuse::{Fused, FusionConfig, Sided, Verdict, fuse};
use crate::detect::{BoxPx, Detection, Detector, GroundScale, LeftImage};
use emberfix_calib::{Eye, RawPixel, RectifiedPixel, Rig};
use opencv::core::Mat;
use opencv::imgproc;
use std::sync::Arc;

/// Nothing is looked for nearer than that, metres.
const NEAREST_M: f64 = 5.0;
/// Where nothing is known of the ground: the middle of what a stereo pair is flown at, metres.
const USUAL_M: f64 = 30.0;

/// The right eye's detector and how it is heard.
pub struct RightEye {
    detector: Box<dyn Detector>,
    config: FusionConfig,
}

impl RightEye {
    /// A detector for the right eye's pictures.
    #[must_use]
    pub fn new(detector: Box<dyn Detector>, config: FusionConfig) -> Self {
        Self { detector, config }
    }

    /// What both eyes show, in the raw left picture. Without a right picture, or where its detector
    /// fails, the left eye's word stands alone.
    pub fn decide(
        &mut self,
        rig: &Rig,
        left: &[Detection],
        (image, right_gray): (&LeftImage, Option<&Mat>),
        counters: &mut Counters,
    ) -> Vec<Detection> {
        let right = right_gray.and_then(|gray| self.look(image, gray, counters));
        if right.is_none() {
            counters.add("spectra", "left_alone");
        }
        let geometry = Geometry {
            rig,
            ground: image.ground.as_ref(),
            has_right: right.is_some(),
        };
        let right = right.unwrap_or_default();
        let fused = geometry.fuse(left, &right, &self.config);
        for one in &fused {
            counters.add("spectra", name_of(one.verdict));
        }
        let detection = |one: &Fused| geometry.detection(one, left);
        fused.iter().map(detection).collect()
    }

    fn look(
        &mut self,
        image: &LeftImage,
        gray: &Mat,
        counters: &mut Counters,
    ) -> Option<Vec<Detection>> {
        let mut bgr = Mat::default();
        let painted = imgproc::cvt_color_def(gray, &mut bgr, imgproc::COLOR_GRAY2BGR);
        let image = LeftImage {
            at: image.at,
            sequence: image.sequence,
            bgr,
            ground: None,
        };
        let found = painted
            .map_err(Into::into)
            .and_then(|()| self.detector.detect(&image));
        match found {
            Ok(found) => Some(found),
            Err(error) => {
                counters.add("right_detector", error.name());
                tracing::warn!(%error, "right image not looked at");
                None
            }
        }
    }
}

fn name_of(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Agreement => "agreement",
        Verdict::OneSided => "one_sided",
        Verdict::Conflict => "conflict",
    }
}

/// Both eyes' boxes in one picture.
pub struct Geometry<'a> {
    /// The rig.
    pub rig: &'a Rig,
    /// How large things on the ground appear in the left picture, where that is known.
    pub ground: Option<&'a GroundScale>,
    /// Whether there is a right picture.
    pub has_right: bool,
}

impl Geometry<'_> {
    /// Decides on raw boxes of both eyes.
    #[must_use]
    pub fn fuse(
        &self,
        left: &[Detection],
        right: &[Detection],
        config: &FusionConfig,
    ) -> Vec<Fused> {
        let sided = |eye: Eye, found: &[Detection]| -> Vec<Sided> {
            found.iter().map(|one| self.sided(eye, one)).collect()
        };
        let rect = self.rig.rectification();
        let reach_px = (
            rect.infinity_disparity_px(),
            self.rig.disparity_px(NEAREST_M),
        );
        fuse(
            &sided(Eye::Left, left),
            &sided(Eye::Right, right),
            config,
            reach_px,
            |u, v| self.rig.disparity_px(self.depth_m(RectifiedPixel { u, v })),
        )
    }

    fn sided(&self, eye: Eye, found: &Detection) -> Sided {
        let rect = self.rig.rectification();
        let BoxPx {
            x,
            y,
            width,
            height,
        } = found.box_px;
        let corners = [
            RawPixel { u: x, v: y },
            RawPixel {
                u: x + width,
                v: y + height,
            },
        ];
        let box_px = match rect.rectify(eye, &corners).as_deref() {
            Ok([low, high]) => BoxPx {
                x: low.u,
                y: low.v,
                width: high.u - low.u,
                height: high.v - low.v,
            },
            // A rig that was rectified to be checked rectifies.
            _ => found.box_px,
        };
        Sided {
            class: found.class,
            score: found.score,
            box_px,
            in_both: self.has_right && self.other_shows(eye, &box_px),
        }
    }

    /// Whether the other eye's picture holds the middle of a box, at the usual depth there.
    fn other_shows(&self, eye: Eye, box_px: &BoxPx) -> bool {
        let (u, v) = box_px.centre();
        let apart = self.rig.disparity_px(self.depth_m(RectifiedPixel { u, v }));
        let (other, u) = match eye {
            Eye::Left => (Eye::Right, u - apart),
            Eye::Right => (Eye::Left, u + apart),
        };
        let raw = self
            .rig
            .rectification()
            .unrectify(other, RectifiedPixel { u, v });
        let (columns, rows) = self.rig.camera(other).image_size_px;
        (0.0..f64::from(columns)).contains(&raw.u) && (0.0..f64::from(rows)).contains(&raw.v)
    }

    /// Depth of the ground there, or the usual one.
    fn depth_m(&self, pixel: RectifiedPixel) -> f64 {
        let raw = self.rig.rectification().unrectify(Eye::Left, pixel);
        let px_per_m = self
            .ground
            .and_then(|ground| ground.px_per_m((raw.u, raw.v)));
        let depth_m = px_per_m.map_or(USUAL_M, |px_per_m| {
            self.rig.camera(Eye::Left).focal_px.0 / px_per_m
        });
        depth_m.max(NEAREST_M)
    }

    fn detection(&self, fused: &Fused, left: &[Detection]) -> Detection {
        let rect = self.rig.rectification();
        let raw = |u: f64, v: f64| rect.unrectify(Eye::Left, RectifiedPixel { u, v });
        let at = fused.box_px;
        let (low, high) = (raw(at.x, at.y), raw(at.x + at.width, at.y + at.height));
        let own = fused.left.and_then(|index| left.get(index));
        Detection {
            class: fused.class,
            score: fused.score,
            box_px: BoxPx {
                x: low.u,
                y: low.v,
                width: high.u - low.u,
                height: high.v - low.v,
            },
            mask: own.and_then(|own| own.mask.as_ref().map(Arc::clone)),
            second_look: own.and_then(|own| own.second_look),
        }
    }
}
