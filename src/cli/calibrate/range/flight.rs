//! Known distances from a flight: a fire that is placed by everything but stereo.
//!
//! The fire's bearings from a flight past it are solved as those of a boresight marker (`crate::boresight`), with
//! the mount and the clock as good as the rig file says. That gives its distance in every picture with the
//! covariance of all of them, against which what stereo measured is held. A GNSS offset that stays is the same
//! for camera and fire and cancels out; one that wanders does not, and is in the covariance.

use super::Fitted;
use crate::boresight::{Gathered, Picker, Ranges, Start, gather, solve};
use crate::cli::Failure;
use crate::cli::calibrate::boresight::{MarkerArguments, detector_of};
use crate::mission::Mission;
use crate::range;
use emberfix_calib::{InverseDepth, Rig, Sightings};
use nalgebra::DVector;
use std::path::{Path, PathBuf};

/// Where known distances come from when there is no table.
#[derive(Debug, clap::Args)]
pub(super) struct FlightArguments {
    /// Recording (MCAP) of a flight towards, past or round one fire, from far and near.
    #[arg(long, value_name = "RECORDING", requires = "mission")]
    pub flight: Option<PathBuf>,
    /// Mission of that flight; its rig file gets the correction.
    #[arg(long, value_name = "MISSION", requires = "flight")]
    mission: Option<PathBuf>,
    /// Boxes from a file instead of the mission's model.
    #[arg(long, value_name = "FILE", requires = "flight")]
    boxes: Option<PathBuf>,
    #[command(flatten)]
    marker: MarkerArguments,
}

/// Gathers, places the fire without stereo, holds stereo against it.
pub(super) fn fit(recording: &Path, arguments: &FlightArguments) -> Result<Fitted, Failure> {
    let Some(path) = &arguments.mission else {
        return Err(Failure::Refused(anyhow::anyhow!(
            "--flight needs --mission"
        )));
    };
    let mission = Mission::load(path).map_err(Failure::refused)?;
    let marker = arguments.marker.marker()?;
    let start = Start::of_calibrated(&mission, marker);
    let gathered = sights(recording, arguments, &mission, &start)?;
    let solution = solve(&start, &gathered.sights).map_err(Failure::failed)?;
    let sightings = held_against(&solution.ranges, &mission.rig);
    let correction = InverseDepth::fit_sightings(&sightings).map_err(Failure::refused)?;
    Ok(Fitted {
        readings: sightings.without_strays().readings(),
        correction,
        rig: mission.rig_path.clone(),
    })
}

fn sights(
    recording: &Path,
    arguments: &FlightArguments,
    mission: &Mission,
    start: &Start,
) -> Result<Gathered, Failure> {
    let detector = detector_of(arguments.boxes.as_deref(), mission)?;
    let ranger = range::open(mission.range_method, &mission.rig, &mission.range)
        .map_err(Failure::refused)?;
    super::super::boresight::with_spinner(|progress| {
        gather(
            recording,
            mission,
            start,
            Picker::Flame(detector, ranger),
            progress,
        )
    })
}

fn held_against(ranges: &Ranges, rig: &Rig) -> Sightings {
    let stereo = |of: fn(&crate::boresight::Stereo) -> f64| {
        DVector::from_iterator(ranges.stereo.len(), ranges.stereo.iter().map(of))
    };
    Sightings {
        per_m: ranges.per_m.clone(),
        covariance: ranges.covariance.clone(),
        measured_per_m: stereo(|stereo| stereo.per_m),
        sigma_per_m: stereo(|stereo| stereo.sigma_per_m),
        alike_per_m: rig.sigmas().disparity_bias_px
            / (rig.rectification().focal_px() * rig.baseline_m()),
    }
}
