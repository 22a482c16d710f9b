//! Evidence over time: rendered flights among things that look like fire, through the detector, the sighting,
//! the tracker and its model of events, as they fly.
//!
//! **In:** a model, flights, a seed. **Out:** how many of the fires were told, how many incidents an hour were
//! told of nothing, how often what was said to be a fire with so much probability was one; or, from flights of
//! another seed, the weights of [`crate::track::event`]. **Worlds** are [`scene`]'s: half of the flights see one or
//! two fires, all see red roofs, orange vehicles, lanterns, headlamps, glitter or fog, one in four under a low
//! red sun. The picture is one tile of a survey camera's, at the rate of a service that looks 2.5 times a second;
//! things stand in it nearly all the time, so that an hour here holds what many hours of patrol do.
//! **Known limits.** One eye: ranges come from parallax and terrain. Rendered flames and rendered lookalikes.

mod fit;
mod flight;
pub mod scene;

use crate::detect::DetectorConfig;
use crate::eval::{Report, Table};
use crate::track::event::NAMES;
use emberfix_calib::Rig;
use emberfix_report::{Axis, Bound, Chart, Figure, Mark, Series, Sheet};
use flight::{Flown, There, Tracked, fly};
use indicatif::ProgressBar;
use rayon::prelude::*;
use std::path::Path;
use std::sync::Arc;

/// What is flown.
#[derive(Debug, Clone)]
pub struct Options {
    /// The detector.
    pub model: DetectorConfig,
    /// Flights of [`scene::FLIGHT_S`].
    pub flights: usize,
    /// Of the flights.
    pub seed: u64,
}

/// Why no flight was flown.
#[derive(Debug, thiserror::Error)]
pub enum EventsError {
    /// The world was refused.
    #[error(transparent)]
    World(#[from] emberfix_sim::world::WorldError),
    /// The datum is nowhere.
    #[error(transparent)]
    Datum(#[from] emberfix_frames::PlaceError),
    /// The rig was refused.
    #[error(transparent)]
    Rig(#[from] emberfix_calib::RigError),
    /// The ranger was refused.
    #[error(transparent)]
    Range(#[from] crate::range::RangeError),
    /// The model was refused.
    #[error(transparent)]
    Model(#[from] crate::detect::ModelError),
}

/// What the right eye of the rig sees.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RightEye {
    /// Light.
    Visible,
    /// Just beyond red.
    NearInfrared,
}

/// A pair of cameras whose picture is one tile of a survey camera's.
///
/// # Errors
/// [`EventsError::Rig`].
pub fn rig(right_eye: RightEye) -> Result<Rig, EventsError> {
    let text = include_str!("rig.toml");
    let text = match right_eye {
        RightEye::Visible => text.to_owned(),
        RightEye::NearInfrared => text.replace("[right]\n", "[right]\nnear_infrared = true\n"),
    };
    Ok(Rig::parse(&text, Path::new("the eval's rig"))?)
}

/// Flies, and holds what was told against what was there.
///
/// # Errors
/// [`EventsError`].
pub fn measure(options: &Options, bar: &ProgressBar) -> Result<Report, EventsError> {
    Ok(report(options, &flights(options, bar)?))
}

/// Flies, and fits the model's weights to what was there.
///
/// # Errors
/// [`EventsError`].
pub fn fitted(options: &Options, bar: &ProgressBar) -> Result<Report, EventsError> {
    let flown = flights(options, bar)?;
    let weights = fit::weights(flown.iter().flat_map(|flown| &flown.tracks));
    let row = |(name, weight): (&&str, &f64)| vec![(*name).to_owned(), format!("{weight:.3}")];
    Ok(Report {
        figures: Vec::new(),
        details: serde_json::json!({"seed": options.seed, "weights": weights}),
        tables: vec![Table {
            title: format!(
                "Weights of track::event, from {} tracks of {} flights",
                flown.iter().map(|flown| flown.tracks.len()).sum::<usize>(),
                flown.len()
            ),
            header: vec!["feature".to_owned(), "weight".to_owned()],
            rows: NAMES.iter().zip(&weights).map(row).collect(),
        }],
        plots: Vec::new(),
    })
}

fn flights(options: &Options, bar: &ProgressBar) -> Result<Vec<Flown>, EventsError> {
    let rig = Arc::new(rig(RightEye::Visible)?);
    let one = |flight: usize| {
        let flown = fly(&rig, &options.model, options.seed, flight);
        bar.inc(1);
        flown
    };
    (0..options.flights).into_par_iter().map(one).collect()
}

/// Of what is said with a probability in a tenth: how much on average, how often it is so, and how many.
type Tenth = (f64, f64, usize);

fn tenths(flown: &[Flown]) -> Vec<Tenth> {
    let tracks = flown.iter().flat_map(|flown| &flown.tracks);
    let said: Vec<(f64, bool)> = tracks
        .flat_map(|track| {
            let asked = fit::asked(track).into_iter();
            asked.map(|moment| (moment.probability, moment.burns))
        })
        .collect();
    let tenth = |number: usize| {
        let inside = |(said, _): &&(f64, bool)| ((said * 10.0) as usize).min(9) == number;
        let here: Vec<_> = said.iter().filter(inside).collect();
        let n = here.len() as f64;
        let mean = here.iter().map(|(said, _)| said).sum::<f64>() / n;
        let right = here.iter().filter(|(_, burns)| *burns).count() as f64 / n;
        (mean, right, here.len())
    };
    (0..10).map(tenth).filter(|(.., n)| *n > 0).collect()
}

fn report(options: &Options, flown: &[Flown]) -> Report {
    let hours = flown.iter().map(|flown| flown.flown_s).sum::<f64>() / 3600.0;
    let fires: Vec<&There> = flown.iter().flat_map(|flown| &flown.fires).collect();
    let told = fires.iter().filter(|fire| fire.told).count();
    let told_of = |track: &Tracked| track.told.as_ref().map(Vec::len);
    let is_false = |track: &&Tracked| told_of(track) == Some(0);
    let tracks = || flown.iter().flat_map(|flown| &flown.tracks);
    let false_incidents = tracks().filter(is_false).count();
    let twice = tracks()
        .filter(|track| told_of(track).is_some_and(|fires| fires > 0))
        .count()
        .saturating_sub(told);
    let visible: usize = fires.iter().map(|fire| fire.visible).sum();
    let seen: usize = fires.iter().map(|fire| fire.seen).sum();
    let tenths = tenths(flown);
    let asked: usize = tenths.iter().map(|(.., n)| n).sum();
    let off = tenths
        .iter()
        .map(|(said, right, n)| (said - right).abs() * *n as f64);
    let share = |part: usize, all: usize| (all > 0).then(|| part as f64 / all as f64);
    let false_boxes: usize = flown.iter().map(|flown| flown.false_boxes).sum();
    let looks = (hours * 3600.0 * scene::LOOKS_HZ) as usize;
    Report {
        figures: vec![
            Figure::bounded(
                "detector.event_recall",
                share(told, fires.len()),
                "",
                Bound::AtLeast(0.97),
                fires.len(),
            ),
            Figure::bounded(
                "detector.false_incidents_per_hour",
                (hours > 0.0).then(|| false_incidents as f64 / hours),
                "",
                Bound::AtMost(1.0),
                flown.len(),
            ),
            Figure::told(
                "detector.events_frame_recall",
                share(seen, visible),
                "",
                visible,
            ),
            Figure::told(
                "detector.events_false_boxes_a_look",
                share(false_boxes, looks),
                "",
                looks,
            ),
            Figure::told(
                "detector.events_calibration_error",
                (asked > 0).then(|| off.sum::<f64>() / asked as f64),
                "",
                asked,
            ),
        ],
        details: serde_json::json!({
            "seed": options.seed,
            "hours": hours,
            "fires": fires,
            "false_incidents": false_incidents,
            "told_again": twice,
            "calibration": tenths,
            "tracks": looked_at(flown),
        }),
        tables: vec![
            Table {
                title: format!("{} flights, {hours:.2} hours", flown.len()),
                header: ["fires", "told", "told again", "false incidents"]
                    .map(str::to_owned)
                    .to_vec(),
                rows: vec![
                    [fires.len(), told, twice, false_incidents]
                        .map(|n| n.to_string())
                        .to_vec(),
                ],
            },
            calibration_table(&tenths),
        ],
        plots: vec![("detector_events".to_owned(), calibration_plot(&tenths))],
    }
}

/// Tracks that were looked at often enough to be told: what they were, and what the model weighed in the end.
fn looked_at(flown: &[Flown]) -> Vec<serde_json::Value> {
    let tracks = flown.iter().enumerate();
    let tracks =
        tracks.flat_map(|(flight, flown)| flown.tracks.iter().map(move |one| (flight, one)));
    tracks
        .filter(|(_, track)| !fit::asked(track).is_empty())
        .map(|(flight, track)| {
            serde_json::json!({
                "flight": flight,
                "burns": track.burns,
                "told": track.told,
                "nearest": track.nearest,
                "last": track.moments.last(),
                "asked": fit::asked(track),
            })
        })
        .collect()
}

fn calibration_table(tenths: &[Tenth]) -> Table {
    let row =
        |(said, right, n): &Tenth| vec![format!("{said:.2}"), format!("{right:.2}"), n.to_string()];
    Table {
        title: "Tracks at each doubling of their looks".to_owned(),
        header: ["said, mean", "is so", "n"].map(str::to_owned).to_vec(),
        rows: tenths.iter().map(row).collect(),
    }
}

fn calibration_plot(tenths: &[Tenth]) -> Sheet {
    let points = tenths
        .iter()
        .map(|(said, right, _)| (*said, *right))
        .collect();
    let chart = Chart::new(
        "Probability of an event",
        Axis::linear("said").within(0.0, 1.0),
        Axis::linear("is so").within(0.0, 1.0),
    )
    .with(Series::new(
        "right as often as it says",
        Mark::Dashed,
        vec![(0.0, 0.0), (1.0, 1.0)],
    ))
    .with(Series::new("tracks", Mark::LineAndDots, points));
    Sheet::of(chart)
}
