//! Ranges a target: semi-global matching in its padded box, or correlation of the whole target.

use super::correlate::{Gray, peak_near, refine};
use super::patch::{Cutter, Margins, Patch};
use super::pool::{Pooled, Sample, pool};
use super::{HsvMask, RangeError, Ranger, Ranging, RawPair, Target};
use crate::detect::DetectionClass;
use emberfix_calib::{RectifiedPixel, Rig};
use opencv::calib3d::{StereoSGBM, StereoSGBM_MODE_SGBM};
use opencv::core::{Mat, MatTraitConst, Point, Ptr, Rect, Vec3b};
use opencv::prelude::{MatTraitConstManual, StereoMatcherTrait};
use serde::{Deserialize, Serialize};

/// How the disparity is found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MatchMethod {
    /// Semi-global matching per pixel, pooled (P3, P4). Pulled towards whole pixels by up to
    /// 0.14 px.
    Sgbm,
    /// Semi-global matching to the pixel, then least squares over the whole target.
    #[default]
    Correlate,
}

/// How to match. [`SgbmConfig::problems`] checks the numbers.
#[derive(Debug, Clone, PartialEq)]
pub struct SgbmConfig {
    /// How the disparity is found.
    pub method: MatchMethod,
    /// Which pixels of the box count.
    pub mask: HsvMask,
    /// Disparities that are tried, a multiple of 16.
    pub num_disparities: u32,
    /// Side of the matched block, odd.
    pub block_px: u32,
    /// Percent by which the best match must beat the second.
    pub uniqueness_percent: u32,
    /// Largest patch of lone disparities that is dropped, pixels.
    pub speckle_window_px: u32,
    /// Greatest difference of left-to-right and right-to-left disparities, pixels.
    pub left_right_max_px: u32,
    /// Sobel values are clipped to this (P4: 15).
    pub pre_filter_cap: u32,
    /// Context around the box, pixels.
    pub context_px: u32,
    /// Fewest pixels that a disparity may rest on.
    pub min_support: u32,
    /// Least share of the valid pixels that must agree.
    pub min_agreement: f64,
    /// Least normalised correlation of the target at its disparity.
    pub min_correlation: f64,
    /// No disparity is better than this, one sigma.
    pub sigma_floor_px: f64,
    /// Range sigma over range from which a disparity only says "at least this far".
    pub max_sigma_over_range: f64,
}

impl Default for SgbmConfig {
    fn default() -> Self {
        Self {
            method: MatchMethod::default(),
            mask: HsvMask::default(),
            num_disparities: 96,
            block_px: 5,
            uniqueness_percent: 5,
            speckle_window_px: 50,
            left_right_max_px: 1,
            pre_filter_cap: 31,
            context_px: 16,
            min_support: 12,
            min_agreement: 0.4,
            min_correlation: 0.6,
            sigma_floor_px: 0.1,
            max_sigma_over_range: 0.35,
        }
    }
}

impl SgbmConfig {
    /// Every number that is out of range: key, value, allowed range. Empty when all is well.
    #[must_use]
    pub fn problems(&self) -> Vec<String> {
        let mut problems = Vec::new();
        let mut within = |key: &str, value: f64, low: f64, high: f64| {
            if !(low..=high).contains(&value) {
                problems.push(format!("{key} is {value}, allowed is {low} to {high}"));
            }
        };
        within(
            "num_disparities",
            f64::from(self.num_disparities),
            16.0,
            512.0,
        );
        within("block_px", f64::from(self.block_px), 3.0, 21.0);
        within(
            "uniqueness_percent",
            f64::from(self.uniqueness_percent),
            0.0,
            50.0,
        );
        within(
            "speckle_window_px",
            f64::from(self.speckle_window_px),
            0.0,
            1000.0,
        );
        within(
            "left_right_max_px",
            f64::from(self.left_right_max_px),
            0.0,
            16.0,
        );
        within("pre_filter_cap", f64::from(self.pre_filter_cap), 1.0, 63.0);
        within("context_px", f64::from(self.context_px), 4.0, 128.0);
        within("min_support", f64::from(self.min_support), 4.0, 10_000.0);
        within("min_agreement", self.min_agreement, 0.1, 1.0);
        within("min_correlation", self.min_correlation, 0.0, 0.99);
        within("sigma_floor_px", self.sigma_floor_px, 0.01, 2.0);
        within("max_sigma_over_range", self.max_sigma_over_range, 0.01, 1.0);
        if !self.num_disparities.is_multiple_of(16) {
            problems.push(format!(
                "num_disparities is {}, allowed are multiples of 16",
                self.num_disparities
            ));
        }
        if self.block_px.is_multiple_of(2) {
            problems.push(format!(
                "block_px is {}, allowed are odd numbers",
                self.block_px
            ));
        }
        problems
    }
}

/// Ranges flames by stereo matching inside their boxes.
pub struct SgbmRanger {
    config: SgbmConfig,
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
    pub fn new(rig: &Rig, config: SgbmConfig) -> Result<Self, RangeError> {
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
            match config.method {
                MatchMethod::Sgbm => Some(Found::pooled(&pooled, config.block_px)),
                MatchMethod::Correlate => refine(&left, &right, &pixels, peak.disparity_px).map(
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
            return Ok(Ranging::NoMatch);
        };
        let margins = self.margins();
        let Some(patch) = self
            .cutter
            .cut(&pair.left_bgr, right, &target.box_px, margins)?
        else {
            return Ok(Ranging::NoMatch);
        };
        let mask = target_mask(&patch, &self.config)?;
        let samples = self.samples(&patch, &mask)?;
        let found = self.measure(&patch, &samples)?;
        Ok(found.map_or(Ranging::NoMatch, |found| {
            self.reach.judge(&found, patch.origin)
        }))
    }
}

impl Reach {
    fn judge(&self, found: &Found, origin: (i32, i32)) -> Ranging {
        let from_infinity = found.disparity_px - self.infinity_px;
        let sigma = found.sigma_px.hypot(self.bias_px);
        if from_infinity < -2.0 * sigma {
            // Beyond infinity: swapped eyes or a wrong match, not a far fire.
            return Ranging::NoMatch;
        }
        if from_infinity < 2.0 * sigma || sigma > self.max_sigma_over_range * from_infinity {
            let at_least_m = self.focal_baseline / (from_infinity.max(0.0) + 2.0 * sigma);
            return Ranging::BeyondReach { at_least_m };
        }
        let (column, row) = found.pooled.centroid;
        Ranging::Measured {
            disparity_px: found.disparity_px,
            sigma_px: found.sigma_px,
            support: found.pooled.support,
            centroid: RectifiedPixel {
                u: column + f64::from(origin.0),
                v: row + f64::from(origin.1),
            },
        }
    }
}

fn matcher(config: &SgbmConfig, least: i32) -> opencv::Result<Ptr<StereoSGBM>> {
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
fn target_mask(patch: &Patch, config: &SgbmConfig) -> Result<Vec<bool>, RangeError> {
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
    config: &SgbmConfig,
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
