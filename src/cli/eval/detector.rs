//! `emberfix eval detector`.

use crate::cli::Failure;
use crate::detect::{DetectorConfig, Family};
use crate::eval::detector::{
    DetectorEvalError, Measured, Options, Spectrum, measure, pictures, tiling,
};
use anyhow::Context;
use indicatif::{ProgressBar, ProgressStyle};
use std::path::{Path, PathBuf};

/// How well a detector finds fire in labelled pictures.
#[derive(Debug, clap::Args)]
pub struct DetectorArguments {
    #[command(flatten)]
    common: super::Common,
    /// ONNX file.
    model: PathBuf,
    /// Folder with manifest.csv and splits/, or with images/ and labels/.
    dataset: PathBuf,
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
    /// What tiles bring, and nothing else: recall of small flames with and without them.
    #[arg(long)]
    tiling: bool,
    /// Pictures looked at in a second, for rates of false alarms.
    #[arg(long, default_value_t = 1.0)]
    hz: f64,
}

fn family(name: &str) -> Result<Family, String> {
    let known: Vec<&str> = Family::all().map(Family::name).collect();
    let family = Family::all().find(|family| family.name() == name);
    family.ok_or_else(|| format!("known are {}", known.join(", ")))
}

/// Measures and shows.
pub fn detector(arguments: &DetectorArguments) -> Result<(), Failure> {
    let usual = |path: &PathBuf| DetectorConfig {
        threads: 1,
        ..DetectorConfig::new(path)
    };
    let options = Options {
        model: DetectorConfig {
            family: arguments.family,
            names: arguments.names.clone(),
            threshold: arguments.threshold,
            ..usual(&arguments.model)
        },
        beside: arguments.beside.iter().map(usual).collect(),
        dataset: arguments.dataset.clone(),
        split: arguments.split.clone(),
        spectrum: arguments.spectrum,
        hz: arguments.hz,
    };
    let problems = options.model.problems();
    if !problems.is_empty() {
        return Err(Failure::Refused(anyhow::anyhow!(problems.join("; "))));
    }
    let pictures = pictures(&options).map_err(Failure::refused)?;
    let bar = ProgressBar::new(pictures.len() as u64).with_style(
        ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} {eta}")
            .unwrap_or_else(|_| ProgressStyle::default_bar()),
    );
    bar.set_message("pictures");
    let failure = |error| match error {
        DetectorEvalError::Model(_) => Failure::refused(error),
        _ => Failure::failed(error),
    };
    let told = || bar.inc(1);
    if arguments.tiling {
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
