//! `emberfix eval detector`.

use crate::cli::Failure;
use crate::detect::fuse::FusionConfig;
use crate::detect::{DetectorConfig, Family};
use crate::eval::detector::{
    DetectorEvalError, Measured, Options, Spectrum, events, measure, pictures, spectra, tiling,
};
use anyhow::Context;
use indicatif::{ProgressBar, ProgressStyle};
use std::path::{Path, PathBuf};

/// What is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Part {
    /// Boxes in labelled pictures, looked at whole.
    Pictures,
    /// What tiles bring: recall of small flames with and without them.
    Tiling,
    /// Fires and false incidents over simulated flights among things that look like fire.
    Events,
    /// What a second, near-infrared eye brings on simulated pairs.
    Spectra,
}

/// How well a detector finds fire: in labelled pictures, or over simulated flights.
#[derive(Debug, clap::Args)]
pub struct DetectorArguments {
    #[command(flatten)]
    common: super::Common,
    /// ONNX file.
    model: PathBuf,
    /// Folder with manifest.csv and splits/, or with images/ and labels/; for `pictures` and `tiling`.
    dataset: Option<PathBuf>,
    /// What to measure.
    #[arg(long, value_enum, default_value = "pictures")]
    part: Part,
    /// Split of the data set, where it has splits.
    #[arg(long, default_value = "test")]
    split: String,
    /// Pictures of which light, where the data set has both.
    #[arg(long, value_enum, default_value = "visible")]
    spectrum: Spectrum,
    /// Other models, in the same tables.
    #[arg(long, value_name = "MODEL")]
    beside: Vec<PathBuf>,
    /// Family of the model, if its metadata do not say.
    #[arg(long, value_parser = family)]
    family: Option<Family>,
    /// Names of its classes in order, if its metadata do not say.
    #[arg(long, value_delimiter = ',')]
    names: Option<Vec<String>>,
    /// Least score that counts, instead of the model's own.
    #[arg(long)]
    threshold: Option<f64>,
    /// Pictures looked at in a second, for rates of false alarms.
    #[arg(long, default_value_t = 1.0)]
    hz: f64,
    /// Flights of `events`, pairs of `spectra`.
    #[arg(long, default_value_t = 270)]
    flights: usize,
    /// Of what is simulated.
    #[arg(long, default_value_t = 7001)]
    seed: u64,
    /// With `events`: fit the model of events to the flights and print its weights. Never on a seed that a
    /// report uses.
    #[arg(long)]
    fit: bool,
    /// With `events`: nothing is looked at twice.
    #[arg(long)]
    no_second_look: bool,
    /// With `spectra`: the right eye's model, if it is another.
    #[arg(long, value_name = "MODEL")]
    right_model: Option<PathBuf>,
}

fn family(name: &str) -> Result<Family, String> {
    let known: Vec<&str> = Family::all().map(Family::name).collect();
    let family = Family::all().find(|family| family.name() == name);
    family.ok_or_else(|| format!("known are {}", known.join(", ")))
}

/// Measures and shows.
pub fn detector(arguments: &DetectorArguments) -> Result<(), Failure> {
    let model = DetectorConfig {
        family: arguments.family,
        names: arguments.names.clone(),
        threshold: arguments.threshold,
        ..usual(&arguments.model)
    };
    let problems = model.problems();
    if !problems.is_empty() {
        return Err(Failure::Refused(anyhow::anyhow!(problems.join("; "))));
    }
    match arguments.part {
        Part::Pictures | Part::Tiling => in_pictures(arguments, model),
        Part::Events => over_flights(arguments, model),
        Part::Spectra => in_pairs(arguments, model),
    }
}

fn usual(path: &PathBuf) -> DetectorConfig {
    DetectorConfig {
        threads: 1,
        ..DetectorConfig::new(path)
    }
}

fn in_pictures(arguments: &DetectorArguments, model: DetectorConfig) -> Result<(), Failure> {
    let Some(dataset) = arguments.dataset.clone() else {
        return Err(Failure::Refused(anyhow::anyhow!(
            "a data set is needed: a folder with manifest.csv and splits/, or with images/ and labels/"
        )));
    };
    let options = Options {
        model,
        beside: arguments.beside.iter().map(usual).collect(),
        dataset,
        split: arguments.split.clone(),
        spectrum: arguments.spectrum,
        hz: arguments.hz,
    };
    let pictures = pictures(&options).map_err(Failure::refused)?;
    let bar = bar(pictures.len(), "pictures");
    let told = || bar.inc(1);
    if arguments.part == Part::Tiling {
        let report = tiling::measure(&options, &pictures, &told).map_err(failure)?;
        bar.finish_and_clear();
        return super::show(&arguments.common, "detector_tiling", &report);
    }
    let measured = measure(&options, &pictures, &told).map_err(failure)?;
    bar.finish_and_clear();
    if let Some(folder) = &arguments.common.out {
        save(folder, &measured).map_err(Failure::Failed)?;
    }
    super::show(&arguments.common, "detector", &measured.report)
}

fn over_flights(arguments: &DetectorArguments, model: DetectorConfig) -> Result<(), Failure> {
    let options = events::Options {
        model: DetectorConfig {
            second_look: !arguments.no_second_look,
            ..model
        },
        flights: arguments.flights,
        seed: arguments.seed,
    };
    let bar = bar(options.flights, "flights");
    let flown = if arguments.fit {
        events::fitted(&options, &bar)
    } else {
        events::measure(&options, &bar)
    };
    let report = flown.map_err(|error| failure(error.into()))?;
    bar.finish_and_clear();
    super::show(&arguments.common, "detector_events", &report)
}

fn in_pairs(arguments: &DetectorArguments, model: DetectorConfig) -> Result<(), Failure> {
    let options = spectra::Options {
        right_model: usual(arguments.right_model.as_ref().unwrap_or(&arguments.model)),
        model,
        fusion: FusionConfig::default(),
        scenes: arguments.flights,
        seed: arguments.seed,
    };
    let bar = bar(options.scenes, "pairs");
    let report = spectra::measure(&options, &bar).map_err(failure)?;
    bar.finish_and_clear();
    super::show(&arguments.common, "detector_spectra", &report)
}

fn bar(length: usize, what: &'static str) -> ProgressBar {
    let style = ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} {eta}");
    let bar = ProgressBar::new(length as u64)
        .with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
    bar.set_message(what);
    bar
}

fn failure(error: DetectorEvalError) -> Failure {
    match error {
        DetectorEvalError::Model(_) => Failure::refused(error),
        _ => Failure::failed(error),
    }
}

fn save(folder: &Path, measured: &Measured) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    for (name, sheet) in &measured.sheets {
        let path = folder.join(name).with_added_extension("png");
        opencv::imgcodecs::imwrite_def(&path, sheet).with_context(|| path.display().to_string())?;
        eprintln!("written: {}", path.display());
    }
    for (name, file) in &measured.files {
        let path = folder.join(name).with_added_extension("json");
        std::fs::write(&path, file.to_string()).with_context(|| path.display().to_string())?;
        eprintln!("written: {}", path.display());
    }
    Ok(())
}
