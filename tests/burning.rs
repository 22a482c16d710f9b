//! How a fire burns, from the spectrometer's readings in a recording to the alarm: the whole way, by
//! the real program.

#![expect(clippy::unwrap_used, reason = "a test may stop at its first surprise")]

#[path = "support/flight.rs"]
mod flight;
#[path = "support/hover.rs"]
mod hover;
#[path = "support/pictures.rs"]
#[expect(dead_code, reason = "no lens is covered here")]
mod pictures;
#[path = "support/replays.rs"]
mod replays;
mod support;

use emberfix::assess::spectrum::Spectrum;
use emberfix::ingest::StereoPair;
use serde_json::Value;
use support::Scratch;

/// Pairs, ten a second.
const PAIRS: u64 = 140;

/// A reading with sodium's line of this light, and a little noise that repeats.
fn reading(pair: &StereoPair, light: f64) -> Spectrum {
    let wavelengths: Vec<f64> = (0..120).map(|k| 560.0 + 0.5 * f64::from(k)).collect();
    let wiggle = 1.0 + 0.02 * (pair.sequence as f64 * 2.7).sin();
    let line = |nm: f64| light * wiggle * (-(nm - 589.3).powi(2)).exp();
    let intensity = wavelengths.iter().map(|nm| 3.0 + line(*nm)).collect();
    Spectrum::new(pair.left.at, wavelengths, intensity).unwrap()
}

/// Summary and the one alarm of a hover whose spectrometer sees `light` at each pair.
fn flown(light: impl Fn(u64) -> Option<f64>) -> (Value, Value) {
    let scratch = Scratch::new();
    let recording = hover::record(&scratch, PAIRS, |pair| {
        let light = light(pair.sequence);
        pair.spectra = light
            .map(|light| reading(pair, light))
            .into_iter()
            .collect();
    });
    let boxes = scratch.write("boxes.csv", pictures::boxes(PAIRS));
    let boxes = ["--boxes", boxes.to_str().unwrap()];
    let summary = replays::replay(&scratch, &recording, "out", &boxes).json();
    let text = std::fs::read(scratch.path("out").join("alarms.geojson")).unwrap();
    let alarms: Value = serde_json::from_slice(&text).unwrap();
    (summary, alarms["features"][0]["properties"].clone())
}

#[test]
fn light_that_rises_by_five_percent_a_second_is_a_growing_fire() {
    let (summary, alarm) = flown(|k| Some(40.0 * (0.005 * k as f64).exp()));
    assert_eq!(
        summary["counters"]["spectrometer"]["read"], PAIRS,
        "{summary}"
    );
    assert_eq!(alarm["state"], "growing", "{alarm:#}");
    let trend = alarm["trend"].as_f64().unwrap();
    assert!((0.03..0.07).contains(&trend), "{trend}");
    assert!(alarm["trend_probability"]["growing"].as_f64().unwrap() > 0.9);
    assert!(
        alarm["size_sigma_m"]["width"].as_f64().unwrap() > 0.0,
        "{alarm:#}"
    );
    assert!(alarm["area"]["polygon"].as_array().unwrap().len() > 8);
    let history = alarm["intensity_history"].as_array().unwrap();
    assert!((8..=24).contains(&history.len()), "{history:?}");
}

#[test]
fn a_spectrometer_that_dies_mid_fire_makes_no_dying_fire() {
    let (_, alarm) = flown(|k| (k < 100).then_some(40.0));
    assert_eq!(alarm["state"], "steady", "{alarm:#}");
    let degraded = alarm["degraded"].as_array().unwrap();
    assert!(
        degraded.iter().any(|reason| reason == "spectral_silent"),
        "the loss is not told: {alarm:#}"
    );
}
