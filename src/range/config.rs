//! Which way to range, and its numbers.

use super::HsvMask;
use serde::{Deserialize, Serialize};

/// One way to find a disparity.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// Semi-global matching per pixel in the box, pooled (P3, P4). Pulled towards whole pixels by up
    /// to 0.14 px.
    Sgbm,
    /// Centroids of the flame's pixels in both eyes (P1).
    Centroid,
    /// Normalised correlation of the whole target, then least squares below the pixel.
    Correlate,
    /// The same on features that survive a change of spectrum (P4: visible and near infrared).
    CrossSpectral,
    /// All that apply, weighed by what each says of its own error.
    #[default]
    Best,
}

impl Method {
    /// All of them.
    pub const ALL: [Self; 5] = [
        Self::Sgbm,
        Self::Centroid,
        Self::Correlate,
        Self::CrossSpectral,
        Self::Best,
    ];

    /// The name that a mission uses.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Sgbm => "sgbm",
            Self::Centroid => "centroid",
            Self::Correlate => "correlate",
            Self::CrossSpectral => "cross_spectral",
            Self::Best => "best",
        }
    }

    /// The method of a name.
    #[must_use]
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|method| method.name() == name)
    }
}

/// A set of methods: those that a result rests on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Methods(u8);

impl Methods {
    /// Only this one.
    #[must_use]
    pub fn only(method: Method) -> Self {
        Self(1 << method as u8)
    }

    /// Those of both sets.
    #[must_use]
    pub fn with(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// Whether a method is among them.
    #[must_use]
    pub fn contains(self, method: Method) -> bool {
        self.0 & (1 << method as u8) != 0
    }

    /// Each of them.
    pub fn iter(self) -> impl Iterator<Item = Method> {
        Method::ALL
            .into_iter()
            .filter(move |method| self.contains(*method))
    }
}

impl std::fmt::Display for Methods {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let names: Vec<_> = self.iter().map(Method::name).collect();
        f.write_str(&names.join("+"))
    }
}

/// How to range. [`RangeConfig::problems`] checks the numbers.
#[derive(Debug, Clone, PartialEq)]
pub struct RangeConfig {
    /// Which pixels of the box count.
    pub mask: HsvMask,
    /// Disparities that are tried, a multiple of 16.
    pub num_disparities: u32,
    /// Side of the block that semi-global matching compares, odd.
    pub block_px: u32,
    /// Percent by which semi-global matching's best match must beat the second.
    pub uniqueness_percent: u32,
    /// Largest patch of lone disparities that semi-global matching drops, pixels.
    pub speckle_window_px: u32,
    /// Greatest difference of left-to-right and right-to-left disparities, pixels.
    pub left_right_max_px: u32,
    /// Semi-global matching clips Sobel values to this (P4: 15).
    pub pre_filter_cap: u32,
    /// Context around the box, pixels.
    pub context_px: u32,
    /// Fewest pixels that a disparity may rest on.
    pub min_support: u32,
    /// Least share of the valid pixels that must agree (semi-global matching).
    pub min_agreement: f64,
    /// Least normalised correlation of the target at its disparity.
    pub min_correlation: f64,
    /// No disparity is better than this, one sigma.
    pub sigma_floor_px: f64,
    /// Range sigma over range from which a disparity only says "at least this far".
    pub max_sigma_over_range: f64,
}

impl Default for RangeConfig {
    fn default() -> Self {
        Self {
            mask: HsvMask::default(),
            num_disparities: 96,
            block_px: 5,
            uniqueness_percent: 5,
            speckle_window_px: 50,
            left_right_max_px: 1,
            pre_filter_cap: 31,
            context_px: 16,
            min_support: 12,
            min_agreement: 0.5,
            min_correlation: 0.6,
            sigma_floor_px: 0.02,
            max_sigma_over_range: 0.35,
        }
    }
}

impl RangeConfig {
    /// Every number that is out of range: key, value, allowed range. Empty when all is well.
    #[must_use]
    pub fn problems(&self) -> Vec<String> {
        let mut problems = Vec::new();
        for (key, value, low, high) in [
            (
                "num_disparities",
                f64::from(self.num_disparities),
                16.0,
                512.0,
            ),
            ("block_px", f64::from(self.block_px), 3.0, 21.0),
            (
                "uniqueness_percent",
                f64::from(self.uniqueness_percent),
                0.0,
                50.0,
            ),
            (
                "speckle_window_px",
                f64::from(self.speckle_window_px),
                0.0,
                1000.0,
            ),
            (
                "left_right_max_px",
                f64::from(self.left_right_max_px),
                0.0,
                16.0,
            ),
            ("pre_filter_cap", f64::from(self.pre_filter_cap), 1.0, 63.0),
            ("context_px", f64::from(self.context_px), 4.0, 128.0),
            ("min_support", f64::from(self.min_support), 4.0, 10_000.0),
            ("min_agreement", self.min_agreement, 0.1, 1.0),
            ("min_correlation", self.min_correlation, 0.0, 0.99),
            ("sigma_floor_px", self.sigma_floor_px, 0.001, 2.0),
            ("max_sigma_over_range", self.max_sigma_over_range, 0.01, 1.0),
        ] {
            if !(low..=high).contains(&value) {
                problems.push(format!("{key} is {value}, allowed is {low} to {high}"));
            }
        }
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
