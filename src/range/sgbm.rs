//! Ranges a target: semi-global matching in its padded box, or correlation of the whole target.

use super::correlate::{Gray, peak_near, refine};
use super::patch::{Cutter, Margins, Patch};
use super::pool::{Pooled, Sample, pool};
use super::{
    Disparity, Method, Methods, RangeConfig, RangeError, Ranger, Ranging, RawPair, Refusal, Target,
};
use crate::detect::DetectionClass;
use emberfix_calib::{RectifiedPixel, Rig};
use opencv::calib3d::{StereoSGBM, StereoSGBM_MODE_SGBM};
use opencv::core::{Mat, MatTraitConst, Point, Ptr, Rect, Vec3b};
use opencv::prelude::{MatTraitConstManual, StereoMatcherTrait};

/// Ranges flames by stereo matching inside their boxes.
pub(super) struct SgbmRanger {
    method: Method,
    config: RangeConfig,
    cutter: Cutter,
    matcher: Ptr<StereoSGBM>,
    search: Search,
    reach: Reach,
}

/// Disparities that are tried, whole pixels, both ends included.
#[derive(Debug, Clone, Copy)]
struct Search {
    least: i32,
    greatest: i32,
}

/// What decides how far a disparity reaches.
#[derive(Debug, Clone, Copy)]
struct Reach {
    /// Focal length times baseline, pixels times metres.
    focal_baseline: f64,
    infinity_px: f64,
    /// Disparity error that calibration leaves, one sigma.
    bias_px: f64,
    max_sigma_over_range: f64,
}

/// Disparities below infinity's that are tried, so that noise there is not cut off on one side.
const BELOW_INFINITY_PX: i32 = 4;

/// Pixels that are matched as one, at most: more of them no longer lower the error.
const MAX_PIXELS: usize = 3000;

impl SgbmRanger {
    /// A ranger for one rig.
    ///
    /// # Errors
    /// [`RangeError::OpenCv`] when OpenCV refuses the configuration or the rig's maps.
    pub fn new(method: Method, rig: &Rig, config: RangeConfig) -> Result<Self, RangeError> {
        let rectification = rig.rectification();
        let infinity_px = rectification.infinity_disparity_px();
        let least = infinity_px.floor() as i32 - BELOW_INFINITY_PX;
        let search = Search {
            least,
            greatest: least + config.num_disparities as i32 - 1,
        };
        Ok(Self {
            cutter: Cutter::new(rig)?,
            matcher: matcher(&config, least)?,
            search,
            reach: Reach {
                focal_baseline: rectification.focal_px() * rig.baseline_m(),
                infinity_px,
                bias_px: rig.sigmas().disparity_bias_px,
                max_sigma_over_range: config.max_sigma_over_range,
            },
            config,
            method,
        })
    }

    fn margins(&self) -> Margins {
        Margins {
            context: self.config.context_px as i32,
            left: self.search.greatest.max(0),
            right: (-self.search.least).max(0),
        }
    }

    /// Every valid disparity under the mask.
    fn samples(&mut self, patch: &Patch, mask: &[bool]) -> Result<Vec<Sample>, RangeError> {
        let mut disparities = Mat::default();
        self.matcher
            .compute(&patch.left_gray, &patch.right_gray, &mut disparities)?;
        let invalid = (self.search.least - 1) * 16;
        let mut samples = Vec::new();
        for (column, row) in masked(patch, mask) {
            let sixteenths = i32::from(*disparities.at_2d::<i16>(row, column)?);
            let disparity_px = f64::from(sixteenths) / 16.0;
            let partner = f64::from(column) - disparity_px;
            let seen = f64::from(patch.seen_columns.0)..f64::from(patch.seen_columns.1);
            if sixteenths > invalid && seen.contains(&partner) {
                samples.push(Sample {
                    at: (column, row),
                    disparity_px,
                });
            }
        }
        Ok(samples)
    }

    /// Disparity, sigma and what they rest on, if most of the target agrees.
    fn measure(&self, patch: &Patch, samples: &[Sample]) -> Result<Option<Found>, RangeError> {
        let Some(pooled) = pool(samples) else {
            return Ok(None);
        };
        let config = &self.config;
        if pooled.support < config.min_support || pooled.agreement < config.min_agreement {
            return Ok(None);
        }
        let (left, right) = (gray(&patch.left_gray)?, gray(&patch.right_gray)?);
        let every = samples.len().div_ceil(MAX_PIXELS);
        let pixels: Vec<_> = samples
            .iter()
            .step_by(every)
            .map(|sample| sample.at)
            .collect();
        let whole = pooled.disparity_px.round() as i32;
        // A disparity that the target as a whole does not bear out is a phantom.
        let Some(peak) = peak_near(&left, &right, &pixels, whole)
            .filter(|peak| peak.correlation >= config.min_correlation)
        else {
            return Ok(None);
        };
        let found =
            match self.method {
                Method::Sgbm => Some(Found::pooled(&pooled, config.block_px)),
                _ => refine(&left, &right, &pixels, peak.disparity_px).map(
                    |(disparity_px, sigma_px)| Found {
                        disparity_px,
                        sigma_px,
                        pooled,
                    },
                ),
            };
        Ok(found.map(|found| Found {
            sigma_px: found.sigma_px.max(config.sigma_floor_px),
            ..found
        }))
    }
}

#[derive(Debug, Clone, Copy)]
struct Found {
    disparity_px: f64,
    sigma_px: f64,
    pooled: Pooled,
}

impl Found {
    /// Pixels of one block share their evidence, so only one in a block's area counts.
    fn pooled(pooled: &Pooled, block_px: u32) -> Self {
        let witnesses = (f64::from(pooled.support) / f64::from(block_px * block_px)).max(1.0);
        let sigma_px = pooled.spread_px / witnesses.sqrt();
        Self {
            disparity_px: pooled.disparity_px,
            sigma_px,
            pooled: *pooled,
        }
    }
}

impl Ranger for SgbmRanger {
    fn range(&mut self, pair: &RawPair, target: &Target) -> Result<Ranging, RangeError> {
        self.cutter.check(pair)?;
        let (DetectionClass::Fire | DetectionClass::NonFire, Some(right)) =
            (target.class, &pair.right_gray)
        else {
            return Ok(Ranging::NoMatch {
                why: Refusal::NoPeak,
            });
        };
        let margins = self.margins();
        let Some(patch) = self
            .cutter
            .cut(&pair.left_bgr, right, &target.box_px, margins)?
        else {
            return Ok(Ranging::NoMatch {
                why: Refusal::NoPeak,
            });
        };
        let mask = target_mask(&patch, &self.config)?;
        let samples = self.samples(&patch, &mask)?;
        let found = self.measure(&patch, &samples)?;
        Ok(found.map_or(
            Ranging::NoMatch {
                why: Refusal::NoPeak,
            },
            |found| self.reach.judge(&found, patch.origin, self.method),
        ))
    }
}

impl Reach {
    fn judge(&self, found: &Found, origin: (i32, i32), method: Method) -> Ranging {
        let from_infinity = found.disparity_px - self.infinity_px;
        let sigma = found.sigma_px.hypot(self.bias_px);
        if from_infinity < -2.0 * sigma {
            // Beyond infinity: swapped eyes or a wrong match, not a far fire.
            return Ranging::NoMatch {
                why: Refusal::BeyondInfinity,
            };
        }
        let (column, row) = found.pooled.centroid;
        let found = Disparity {
            px: found.disparity_px,
            sigma_px: found.sigma_px,
            support: found.pooled.support,
            centroid: RectifiedPixel {
                u: column + f64::from(origin.0),
                v: row + f64::from(origin.1),
            },
        };
        let used = Methods::only(method);
        if from_infinity < 2.0 * sigma || sigma > self.max_sigma_over_range * from_infinity {
            let at_least_m = self.focal_baseline / (from_infinity.max(0.0) + 2.0 * sigma);
            return Ranging::BeyondReach {
                at_least_m,
                weak: found,
                used,
            };
        }
        Ranging::Measured {
            disparity_px: found.px,
            sigma_px: found.sigma_px,
            support: found.support,
            centroid: found.centroid,
            used,
        }
    }
}

fn matcher(config: &RangeConfig, least: i32) -> opencv::Result<Ptr<StereoSGBM>> {
    let block = config.block_px as i32;
    StereoSGBM::create(
        least,
        config.num_disparities as i32,
        block,
        // Penalties for a change of one and of more, as OpenCV's authors scale them.
        8 * block * block,
        32 * block * block,
        config.left_right_max_px as i32,
        config.pre_filter_cap as i32,
        config.uniqueness_percent as i32,
        config.speckle_window_px as i32,
        2,
        StereoSGBM_MODE_SGBM,
    )
}

/// The flame's pixels in the target: those that the gate keeps and that outshine the surroundings.
/// Where that leaves too few (dry grass is as yellow as flame), what the gate keeps; where that is
/// too little as well (a thing in colours that the gate does not know), all of them.
fn target_mask(patch: &Patch, config: &RangeConfig) -> Result<Vec<bool>, RangeError> {
    let target = patch.target;
    let gate = config.mask.apply(&patch.left_bgr.roi(target)?)?;
    let floor = brightness_around(patch, config.context_px as i32)?;
    let shining: Vec<bool> = within(&patch.left_bgr, target)?
        .zip(&gate)
        .map(|(pixel, kept)| *kept && shine(pixel) > floor)
        .collect();
    let enough =
        |mask: &[bool]| mask.iter().filter(|kept| **kept).count() >= config.min_support as usize;
    Ok([shining, gate]
        .into_iter()
        .find(|mask| enough(mask))
        .unwrap_or_else(|| vec![true; (target.width * target.height) as usize]))
}

/// How much like flame a pixel shines: bright in red, weak in blue.
fn shine(bgr: [u8; 3]) -> i32 {
    2 * i32::from(bgr[2]) - i32::from(bgr[0])
}

/// Shine that hardly anything around the target exceeds.
fn brightness_around(patch: &Patch, context: i32) -> opencv::Result<i32> {
    let target = patch.target;
    let left = (target.x - context).max(patch.seen_columns.0);
    let right = (target.x + target.width + context).min(patch.seen_columns.1);
    let around = Rect::new(left, 0, right - left, patch.left_bgr.rows());
    let mut shines = Vec::new();
    for (index, pixel) in (0..).zip(within(&patch.left_bgr, around)?) {
        let at = Point::new(left + index % around.width, index / around.width);
        if !target.contains(at) {
            shines.push(shine(pixel));
        }
    }
    if shines.is_empty() {
        return Ok(i32::MIN);
    }
    let rank = shines.len() * 95 / 100;
    Ok(*shines.select_nth_unstable(rank).1)
}

/// The pixels of a part of an 8-bit BGR image, row by row.
fn within(image: &Mat, part: Rect) -> opencv::Result<impl Iterator<Item = [u8; 3]>> {
    let mut rows = Vec::with_capacity(part.height as usize);
    for row in part.y..part.y + part.height {
        let pixels = image.at_row::<Vec3b>(row)?;
        rows.push(&pixels[part.x as usize..(part.x + part.width) as usize]);
    }
    Ok(rows.into_iter().flatten().map(|pixel| pixel.0))
}

/// Patch columns and rows of the mask's pixels.
fn masked<'a>(patch: &Patch, mask: &'a [bool]) -> impl Iterator<Item = (i32, i32)> + 'a {
    let target = patch.target;
    (0..)
        .zip(mask)
        .filter(|(_, kept)| **kept)
        .map(move |(index, _): (i32, _)| {
            (
                target.x + index % target.width,
                target.y + index / target.width,
            )
        })
}

fn gray(image: &Mat) -> opencv::Result<Gray> {
    let values = image
        .data_bytes()?
        .iter()
        .map(|value| f32::from(*value))
        .collect();
    Ok(Gray {
        width: image.cols(),
        values,
    })
}

/// Mean error of the matcher's valid disparities against a truth image in `1 / scale` pixels (0 is
/// unknown), and the share of the known pixels that have a value.
#[cfg(test)]
pub(super) fn mean_error_px(
    config: &RangeConfig,
    left: &Mat,
    right: &Mat,
    truth: &Mat,
    scale: f64,
) -> opencv::Result<(f64, f64)> {
    let mut disparities = Mat::default();
    matcher(config, 0)?.compute(left, right, &mut disparities)?;
    let (mut sum, mut valid, mut known) = (0.0, 0.0, 0.0);
    for row in 0..truth.rows() {
        for (want, got) in truth
            .at_row::<u8>(row)?
            .iter()
            .zip(disparities.at_row::<i16>(row)?)
        {
            known += f64::from(u8::from(*want > 0));
            if *want > 0 && *got >= 0 {
                sum += (f64::from(*got) / 16.0 - f64::from(*want) / scale).abs();
                valid += 1.0;
            }
        }
    }
    Ok((sum / valid, valid / known))
}
