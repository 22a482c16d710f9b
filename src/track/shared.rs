//! The errors that all fires share, estimated from all of their sightings.

use super::TrackConfig;
use crate::locate::{SHARED, Shared};
use nalgebra::{SMatrix, SVector};

/// Mean and covariance of the shared errors, each in units of its own prior sigma, so that a sigma
/// that changes in flight (GNSS accuracy) needs no bookkeeping. Starts at zero with unit covariance.
///
/// Each error wanders as a first-order Gauss-Markov process with its own correlation time: what
/// was learned fades back to the prior, so no error is ever known for good.
#[derive(Debug, Clone, PartialEq)]
pub struct SharedEstimate {
    /// Best guess, sigmas.
    pub mean: SVector<f64, SHARED>,
    /// Its covariance, sigmas squared.
    pub covariance: SMatrix<f64, SHARED, SHARED>,
}

/// How the shared errors moved on: what a fire needs to follow.
#[derive(Debug, Clone)]
pub struct Passage {
    /// Mean before.
    pub mean_before: SVector<f64, SHARED>,
    /// Mean after.
    pub mean_after: SVector<f64, SHARED>,
    /// Expected old error per new error.
    pub old_by_new: SMatrix<f64, SHARED, SHARED>,
    /// What of the old error the new one does not say.
    pub unsaid: SMatrix<f64, SHARED, SHARED>,
}

impl Default for SharedEstimate {
    fn default() -> Self {
        Self { mean: SVector::zeros(), covariance: SMatrix::identity() }
    }
}

impl SharedEstimate {
    /// Lets `dt_s` pass. `None` when nothing changes.
    pub fn age(&mut self, dt_s: f64, config: &TrackConfig) -> Option<Passage> {
        if dt_s <= 0.0 {
            return None;
        }
        let keep = correlations(config).map(|correlation_s| (-dt_s / correlation_s).exp());
        let fade = SMatrix::<f64, SHARED, SHARED>::from_diagonal(&keep);
        let renewed = keep.map(|keep| 1.0 - keep * keep);
        let before = self.clone();
        let across = before.covariance * fade;
        self.mean = keep.component_mul(&before.mean);
        self.covariance = fade * across + SMatrix::from_diagonal(&renewed);
        let inverse = self.covariance.try_inverse()?;
        let old_by_new = across * inverse;
        Some(Passage {
            mean_before: before.mean,
            mean_after: self.mean,
            old_by_new,
            unsaid: before.covariance - old_by_new * across.transpose(),
        })
    }
}

/// Correlation time of each shared error, seconds.
fn correlations(config: &TrackConfig) -> SVector<f64, SHARED> {
    let mut seconds = SVector::repeat(config.mount_correlation_s);
    for axis in 0..3 {
        seconds[Shared::GnssEast as usize + axis] = config.gnss_correlation_s;
    }
    seconds[Shared::Heading as usize] = config.heading_correlation_s;
    seconds
}
