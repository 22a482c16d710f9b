//! Weights of the model of [`crate::track::event`], from tracks of which it is known whether they burn.

use super::flight::{Moment, Tracked};
use crate::track::event::FEATURES;
use nalgebra::{SMatrix, SVector};

/// Pulls weights towards 0, so that what was seldom seen weighs little.
const RIDGE: f64 = 0.01;
/// Newton's steps; a logistic model needs fewer.
const STEPS: usize = 30;
/// A track is asked at each doubling of its looks, from where it may be told: looks between are hardly others.
const FIRST_ASKED: u32 = 8;

/// The moments at which a track is asked.
pub fn asked(track: &Tracked) -> Vec<&Moment> {
    let mut next = FIRST_ASKED;
    let mut asked = Vec::new();
    for moment in &track.moments {
        if moment.hits >= next {
            asked.push(moment);
            next *= 2;
        }
    }
    asked
}

/// Weights that make these tracks likeliest, each as heavy as any other, by Newton's method.
pub fn weights<'a>(tracks: impl Iterator<Item = &'a Tracked>) -> [f64; FEATURES] {
    let samples: Vec<(SVector<f64, FEATURES>, f64, f64)> = tracks
        .flat_map(|track| {
            let asked = asked(track);
            let share = 1.0 / asked.len().max(1) as f64;
            let truth = |moment: &Moment| f64::from(u8::from(moment.burns));
            let sample = move |moment: &&Moment| (moment.features.into(), truth(moment), share);
            asked.iter().map(sample).collect::<Vec<_>>()
        })
        .collect();
    let mut weights = SVector::<f64, FEATURES>::zeros();
    for _ in 0..STEPS {
        let mut slope = weights * RIDGE;
        let mut curvature = SMatrix::<f64, FEATURES, FEATURES>::identity() * RIDGE;
        for (features, truth, share) in &samples {
            let said = 1.0 / (1.0 + (-features.dot(&weights)).exp());
            slope += features * (share * (said - truth));
            curvature += features * features.transpose() * (share * said * (1.0 - said));
        }
        // Positive definite for the ridge.
        let Some(factor) = curvature.cholesky() else {
            break;
        };
        weights -= factor.solve(&slope);
    }
    weights.into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fitted_weights_say_what_is_so_as_often_as_it_is() {
        // Of tracks with a second feature of 1 three in four burn, with -1 one in four.
        let track = |side: f64, burns: bool| {
            let mut features = [0.0; FEATURES];
            (features[0], features[1]) = (1.0, side);
            Tracked {
                burns,
                told: None,
                nearest: None,
                moments: vec![Moment {
                    hits: 8,
                    features,
                    probability: 0.0,
                    burns,
                }],
            }
        };
        let tracks: Vec<Tracked> = (0..400)
            .map(|k| {
                let side = if k % 2 == 0 { 1.0 } else { -1.0 };
                track(side, (k / 2 % 4 < 3) == (side > 0.0))
            })
            .collect();
        let found = weights(tracks.iter());
        let said = |side: f64| 1.0 / (1.0 + (-(found[0] + side * found[1])).exp());
        assert!((said(1.0) - 0.75).abs() < 0.01, "{found:?}");
        assert!((said(-1.0) - 0.25).abs() < 0.01, "{found:?}");
        assert!(found[2..].iter().all(|weight| weight.abs() < 1e-9));
    }
}
