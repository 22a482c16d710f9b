//! Measures the service against truth: each way of measuring is one file or folder here, and one
//! command `emberfix eval NAME`.
//!
//! **In:** options and a seed; truth from the simulator's world, or real data. **Out:** a [`Report`]:
//! the figures with their bounds, tables, plots, and all of it as JSON. **Assumptions.** What is
//! measured is the code that flies, through its public interface. This is the only room that sees the
//! simulator; nothing that flies depends on this room.

pub mod boresight;
pub mod calibration;
pub mod delivery;
pub mod detector;
pub mod ground;
pub mod location;
pub mod range;
pub mod trend;

use emberfix_report::{Figure, PlotError, Sheet};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// What one measurement came to.
#[derive(Debug, Clone, Serialize)]
pub struct Report {
    /// The figures, those with bounds first.
    pub figures: Vec<Figure>,
    /// What the tables show, and what else there is to say, for machines.
    pub details: serde_json::Value,
    /// What people read.
    #[serde(skip)]
    pub tables: Vec<Table>,
    /// What people look at: stem of the file name and what is drawn.
    #[serde(skip)]
    pub plots: Vec<(String, Sheet)>,
}

/// A table for people.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Table {
    /// What it shows.
    pub title: String,
    /// Names of the columns, with units.
    pub header: Vec<String>,
    /// Rows of cells.
    pub rows: Vec<Vec<String>>,
}

impl Report {
    /// Takes another measurement's report in behind this one; its details under a name of their own.
    #[must_use]
    pub fn with(mut self, name: &str, other: Self) -> Self {
        self.figures.extend(other.figures);
        self.tables.extend(other.tables);
        self.plots.extend(other.plots);
        if let Some(details) = self.details.as_object_mut() {
            details.insert(name.to_owned(), other.details);
        }
        self
    }

    /// Whether every figure keeps its bound.
    #[must_use]
    pub fn holds(&self) -> bool {
        self.figures.iter().all(|figure| figure.holds)
    }

    /// Writes each plot as SVG and PNG and the report as `STEM.json`; says what was written.
    ///
    /// # Errors
    /// [`SaveError`] when the folder can't be made, or a file not drawn or written.
    pub fn save(&self, folder: &Path, stem: &str) -> Result<Vec<PathBuf>, SaveError> {
        let writing = |path: &Path, source| SaveError::Writing {
            path: path.to_owned(),
            source,
        };
        std::fs::create_dir_all(folder).map_err(|source| writing(folder, source))?;
        let path = folder.join(stem).with_added_extension("json");
        let json = format!("{:#}\n", serde_json::json!(self));
        std::fs::write(&path, json).map_err(|source| writing(&path, source))?;
        let mut written = vec![path];
        for (name, sheet) in &self.plots {
            let plot = folder.join(name);
            sheet.save(&plot)?;
            written.push(plot.with_added_extension("svg"));
            written.push(plot.with_added_extension("png"));
        }
        Ok(written)
    }
}

/// Why a report could not be kept.
#[derive(Debug, thiserror::Error)]
pub enum SaveError {
    /// Folder or file could not be written.
    #[error("{}: {source}", path.display())]
    Writing {
        /// Where.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A plot could not be made.
    #[error(transparent)]
    Plot(#[from] PlotError),
}
