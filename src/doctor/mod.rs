//! Everything checked before take-off, in one command.
//!
//! **Purpose.** Says what would keep a flight from telling where a fire is, while it can still be put
//! right. **In:** a mission file, and whatever answers to it: camera, autopilot, ground station, disk.
//! **Out:** an [`Examination`]: findings of pass, warn or fail, each with what was found and what to do.
//!
//! Probes ([`probe`]) look and are thin; judges ([`judge`]) are pure and say what it means. Limits stand
//! with the judge that applies them.
//!
//! **Bound.** Each probe ends at its deadline, or is left behind and said to hang; the whole takes the
//! listening time, the patience and some seconds.
//!
//! **Assumptions.** The service itself does not run: the doctor takes its ports.
//! **Known limits.** What only flight shows (a boresight that is off, a clock that lags) is not seen on
//! the ground; `emberfix calibrate boresight` finds it.

pub mod judge;
pub mod probe;

use crate::mission::Mission;
use emberfix_frames::ServiceTime;
use emberfix_report::{Bound, Figure};
use serde::Serialize;
use std::path::PathBuf;
use std::time::Duration;

/// What a finding means for the flight, worst last.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// As it should be.
    Pass,
    /// Works, but worse than it could, or not known for sure.
    Warn,
    /// Positions would be missing, late or wrong.
    Fail,
}

/// One thing that was looked at.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Finding {
    /// What was looked at.
    pub name: &'static str,
    /// What it means.
    pub verdict: Verdict,
    /// What was found, with units.
    pub value: String,
    /// What to do about it; empty when all is well.
    pub remedy: String,
    /// The number behind it, where there is one.
    #[serde(skip)]
    pub figure: Option<Figure>,
}

impl Finding {
    /// As it should be.
    #[must_use]
    pub fn pass(name: &'static str, value: impl Into<String>) -> Self {
        Self {
            name,
            verdict: Verdict::Pass,
            value: value.into(),
            remedy: String::new(),
            figure: None,
        }
    }

    /// Worse than it could be.
    #[must_use]
    pub fn warn(name: &'static str, value: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self {
            verdict: Verdict::Warn,
            remedy: remedy.into(),
            ..Self::pass(name, value)
        }
    }

    /// Not fit to fly.
    #[must_use]
    pub fn fail(name: &'static str, value: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self {
            verdict: Verdict::Fail,
            remedy: remedy.into(),
            ..Self::pass(name, value)
        }
    }

    /// A finding of a given verdict; the remedy is only told when there is something to remedy.
    #[must_use]
    pub fn of(
        verdict: Verdict,
        name: &'static str,
        value: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Self {
        match verdict {
            Verdict::Pass => Self::pass(name, value),
            Verdict::Warn => Self::warn(name, value, remedy),
            Verdict::Fail => Self::fail(name, value, remedy),
        }
    }

    /// The same, with the number behind it.
    #[must_use]
    pub fn with(mut self, figure: Figure) -> Self {
        self.figure = Some(figure);
        self
    }
}

/// Findings on one part of the system.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Section {
    /// Which part.
    pub title: &'static str,
    /// What was found, in the order of looking.
    pub findings: Vec<Finding>,
}

/// All that was found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Examination {
    /// Name of the mission, or its file where it could not be read.
    pub mission: String,
    /// When it began.
    #[serde(serialize_with = "crate::alarm::rfc3339::serialize")]
    pub began_at: ServiceTime,
    /// How long it took, seconds.
    pub took_s: f64,
    /// Whether the mission was refused, so that there was little to examine.
    pub refused: bool,
    /// Part by part.
    pub sections: Vec<Section>,
}

impl Examination {
    /// How many findings have a verdict.
    #[must_use]
    pub fn count(&self, verdict: Verdict) -> usize {
        self.findings()
            .filter(|finding| finding.verdict == verdict)
            .count()
    }

    /// All findings, in order.
    pub fn findings(&self) -> impl Iterator<Item = &Finding> {
        self.sections.iter().flat_map(|section| &section.findings)
    }

    /// The worst verdict.
    #[must_use]
    pub fn verdict(&self) -> Verdict {
        self.findings()
            .map(|finding| finding.verdict)
            .max()
            .unwrap_or(Verdict::Fail)
    }

    /// Failures, warnings, and the number behind every finding that has one.
    #[must_use]
    pub fn figures(&self) -> Vec<Figure> {
        let checks = self.findings().count();
        let count = |verdict| Some(self.count(verdict) as f64);
        let fails = count(Verdict::Fail);
        let mut figures = vec![
            Figure::bounded("doctor.fails", fails, "", Bound::Equals(0.0), checks),
            Figure::told("doctor.warnings", count(Verdict::Warn), "", checks),
        ];
        figures.extend(self.findings().filter_map(|finding| finding.figure.clone()));
        figures
    }
}

/// What to look at, and for how long.
#[derive(Debug, Clone, Default)]
pub struct Options {
    /// MAVLink URL instead of the mission's.
    pub mavlink: Option<String>,
    /// Camera URL instead of the mission's.
    pub camera: Option<String>,
    /// Address of the ground station instead of the mission's.
    pub ground: Option<String>,
    /// Folder of the outbox instead of the mission's.
    pub state: Option<PathBuf>,
    /// How long camera and autopilot are listened to.
    pub listen: Duration,
    /// How long the first pair and the first heartbeat are waited for, before that.
    pub patience: Duration,
}

/// Examines a mission and all that it needs. `tell` hears what is being done, for people who wait.
pub fn examine(path: &std::path::Path, options: &Options, tell: &dyn Fn(&str)) -> Examination {
    let clock = crate::service::service_clock();
    let began_at = clock();
    let took_s = || (clock() - began_at).as_secs_f64();
    tell("reading the mission");
    let read = probe::mission::read(path);
    let first = judge::mission::file(path, &read);
    let Ok(mut mission) = read.mission else {
        let sections = vec![first, judge::computer::clock_alone(began_at)];
        return Examination {
            mission: path.display().to_string(),
            began_at,
            took_s: took_s(),
            refused: true,
            sections,
        };
    };
    options.apply(&mut mission);
    let sections = examine_mission(&mission, &read.rig_age, first, options, tell, began_at);
    Examination {
        mission: mission.name.clone(),
        began_at,
        took_s: took_s(),
        refused: false,
        sections,
    }
}

fn examine_mission(
    mission: &Mission,
    rig_age: &Option<Duration>,
    mut first: Section,
    options: &Options,
    tell: &dyn Fn(&str),
    now: ServiceTime,
) -> Vec<Section> {
    first
        .findings
        .extend(judge::rig::findings(&mission.rig, *rig_age));
    tell("loading the model and timing it");
    let model = probe::model::time(mission);
    tell("writing to the disk");
    let computer = probe::computer::look(&mission.state_dir);
    tell("asking the ground station");
    let ground = probe::ground::ask(mission, now);
    tell("listening to camera and autopilot");
    let (camera, autopilot) = probe::listen(mission, options);
    first
        .findings
        .extend(judge::mission::terrain(mission, autopilot.place()));
    vec![
        first,
        judge::model::section(&model, camera.rate_hz()),
        judge::camera::section(&camera, &mission.rig, &mission.camera_url),
        judge::autopilot::section(&autopilot, mission),
        judge::ground::section(&ground, &autopilot, mission),
        judge::computer::section(&computer, now, &autopilot, &ground),
    ]
}

impl Options {
    fn apply(&self, mission: &mut Mission) {
        if let Some(url) = &self.mavlink {
            mission.mavlink_url.clone_from(url);
        }
        if let Some(url) = &self.camera {
            mission.camera_url.clone_from(url);
        }
        if self.ground.is_some() {
            mission.ground.url.clone_from(&self.ground);
        }
        if let Some(folder) = &self.state {
            mission.state_dir.clone_from(folder);
        }
    }
}

#[cfg(test)]
mod tests;
