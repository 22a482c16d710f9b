//! Labelled pictures from disk.
//!
//! **In:** a folder with `images/` and `labels/` (as the simulator writes them), or one with
//! `manifest.csv` and `splits/NAME.txt`, whose sets each hold `images/` and `labels/`. A label line is
//! `class cx cy width height`, or `class x1 y1 x2 y2 x3 y3 ..` for an outline, all as shares of the
//! picture; class 0 is fire, 1 smoke, 2 what only looks like fire.
//! **Out:** [`Picture`]s, with boxes in pixels whose centres are whole numbers.

use super::coco::Thing;
use crate::detect::{BoxPx, DetectionClass, Mask};
use opencv::core::{Mat, MatTraitConst};
use opencv::imgcodecs::{IMREAD_COLOR, imread};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Why a data set can't be read.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// A file is not there, or can't be read.
    #[error("data set {path}: {source}", path = path.display())]
    Read {
        /// File or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A line that says nothing.
    #[error("data set {path}, line {line}: {problem}", path = path.display())]
    Line {
        /// File.
        path: PathBuf,
        /// From 1.
        line: usize,
        /// What is wrong with it.
        problem: String,
    },
    /// A picture that is none.
    #[error("data set {path}: not a picture that can be decoded", path = path.display())]
    Picture {
        /// File.
        path: PathBuf,
    },
    /// Nothing to score.
    #[error("data set {path}: no pictures of this choice", path = path.display())]
    Empty {
        /// Folder.
        path: PathBuf,
    },
}

/// Which light the pictures show.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Spectrum {
    /// What eyes see.
    Visible,
    /// Heat, by a thermal camera.
    Thermal,
}

/// One labelled picture; its pixels stay on disk.
#[derive(Debug, Clone)]
pub struct Picture {
    /// The file.
    pub path: PathBuf,
    /// What it is a frame of; pictures of one clip resemble each other.
    pub clip: String,
    /// Whether smoke was labelled in it.
    pub smoke_labelled: bool,
    /// The file of its labels.
    labels: PathBuf,
}

/// Pixels and truth of a picture.
pub struct Loaded {
    /// 8-bit BGR.
    pub bgr: Mat,
    /// What is there.
    pub truth: Vec<(DetectionClass, Thing)>,
}

impl Picture {
    /// Reads pixels and labels.
    ///
    /// # Errors
    /// [`DatasetError`] that names the file.
    pub fn load(&self) -> Result<Loaded, DatasetError> {
        let undecodable = || DatasetError::Picture {
            path: self.path.clone(),
        };
        let bgr = imread(&self.path, IMREAD_COLOR).map_err(|_| undecodable())?;
        if bgr.empty() {
            return Err(undecodable());
        }
        let size = (f64::from(bgr.cols()), f64::from(bgr.rows()));
        let text = read(&self.labels)?;
        let mut truth = Vec::new();
        for (line, words) in (1..)
            .zip(text.lines())
            .filter(|(_, words)| !words.trim().is_empty())
        {
            let thing = label(words, size).ok_or_else(|| DatasetError::Line {
                path: self.labels.clone(),
                line,
                problem: format!("{words:?} is no label"),
            })?;
            truth.push(thing);
        }
        Ok(Loaded { bgr, truth })
    }
}

/// The pictures of a data set: of a split and a spectrum, where it tells them apart.
///
/// # Errors
/// [`DatasetError`] that names file and line.
pub fn pictures(
    folder: &Path,
    split: &str,
    spectrum: Spectrum,
) -> Result<Vec<Picture>, DatasetError> {
    let pictures = if folder.join("manifest.csv").exists() {
        of_split(folder, split, spectrum)?
    } else {
        of_folder(folder)?
    };
    if pictures.is_empty() {
        return Err(DatasetError::Empty {
            path: folder.to_owned(),
        });
    }
    Ok(pictures)
}

fn of_split(folder: &Path, split: &str, spectrum: Spectrum) -> Result<Vec<Picture>, DatasetError> {
    let known = manifest(&folder.join("manifest.csv"))?;
    let list = folder
        .join("splits")
        .join(split)
        .with_added_extension("txt");
    let mut pictures = Vec::new();
    for (line, name) in (1..).zip(read(&list)?.lines()) {
        let Some((clip, smoke_labelled)) = known.get(name) else {
            return Err(DatasetError::Line {
                path: list,
                line,
                problem: format!("{name:?} does not stand in manifest.csv"),
            });
        };
        let is_thermal = name
            .split('/')
            .next()
            .is_some_and(|set| set.contains("thermal"));
        if is_thermal == (spectrum == Spectrum::Thermal) {
            pictures.push(picture(folder.join(name), clip.clone(), *smoke_labelled));
        }
    }
    Ok(pictures)
}

/// Clip, and whether smoke was labelled, by path.
fn manifest(path: &Path) -> Result<BTreeMap<String, (String, bool)>, DatasetError> {
    let text = read(path)?;
    let refuse = |line: usize, problem: &str| DatasetError::Line {
        path: path.to_owned(),
        line,
        problem: problem.to_owned(),
    };
    let header: Vec<&str> = text.lines().next().unwrap_or("").split(',').collect();
    let column = |name: &str| {
        let place = header.iter().position(|found| *found == name);
        place.ok_or_else(|| refuse(1, &format!("no column {name}")))
    };
    let (path_at, clip_at, smoke_at) = (
        column("path")?,
        column("cluster")?,
        column("smoke_labelled")?,
    );
    let row = |(line, row): (usize, &str)| {
        let cells: Vec<&str> = row.split(',').collect();
        if cells.len() != header.len() {
            return Err(refuse(line, "not as many cells as the header has"));
        }
        let facts = (cells[clip_at].to_owned(), cells[smoke_at] == "yes");
        Ok((cells[path_at].to_owned(), facts))
    };
    (1..).zip(text.lines()).skip(1).map(row).collect()
}

/// The simulator's pictures: four in a row show one world.
fn of_folder(folder: &Path) -> Result<Vec<Picture>, DatasetError> {
    const POSES: usize = 4;
    let images = folder.join("images");
    let entries = std::fs::read_dir(&images).map_err(|source| DatasetError::Read {
        path: images.clone(),
        source,
    })?;
    let is_picture = |path: &PathBuf| {
        let kind = path.extension().and_then(|kind| kind.to_str());
        matches!(kind, Some("jpg" | "jpeg" | "png"))
    };
    let mut paths: Vec<PathBuf> = entries
        .filter_map(|entry| entry.ok().map(|entry| entry.path()))
        .filter(is_picture)
        .collect();
    paths.sort();
    let world =
        |(number, path): (usize, PathBuf)| picture(path, format!("{:06}", number / POSES), true);
    Ok(paths.into_iter().enumerate().map(world).collect())
}

/// Labels lie in `labels/` beside `images/`.
fn picture(path: PathBuf, clip: String, smoke_labelled: bool) -> Picture {
    let name = path.file_stem().unwrap_or_default().to_owned();
    let set = path
        .parent()
        .and_then(Path::parent)
        .unwrap_or(Path::new(""));
    let labels = set.join("labels").join(name).with_added_extension("txt");
    Picture {
        path,
        clip,
        smoke_labelled,
        labels,
    }
}

fn label(words: &str, (width, height): (f64, f64)) -> Option<(DetectionClass, Thing)> {
    let mut words = words.split_whitespace();
    let class = match words.next()? {
        "0" => DetectionClass::Fire,
        "1" => DetectionClass::Smoke,
        "2" => DetectionClass::NonFire,
        _ => return None,
    };
    let shares: Vec<f64> = words
        .map(|word| {
            word.parse()
                .ok()
                .filter(|share: &f64| (-1.0..=2.0).contains(share))
        })
        .collect::<Option<_>>()?;
    let thing = match shares[..] {
        [cx, cy, across, down] if across > 0.0 && down > 0.0 => Thing {
            box_px: BoxPx {
                x: (cx - across / 2.0) * width - 0.5,
                y: (cy - down / 2.0) * height - 0.5,
                width: across * width,
                height: down * height,
            },
            mask: None,
            score: 1.0,
        },
        ref outline if outline.len() >= 6 && outline.len() % 2 == 0 => {
            let corner = |share: &[f64]| (share[0] * width - 0.5, share[1] * height - 0.5);
            outlined(&outline.chunks_exact(2).map(corner).collect::<Vec<_>>())?
        }
        _ => return None,
    };
    Some((class, thing))
}

/// What a closed outline encloses; corners are columns and rows.
fn outlined(corners: &[(f64, f64)]) -> Option<Thing> {
    let range = |of: fn(&(f64, f64)) -> f64| {
        let low = corners.iter().map(of).fold(f64::INFINITY, f64::min);
        let high = corners.iter().map(of).fold(f64::NEG_INFINITY, f64::max);
        (low.max(0.0), high)
    };
    let ((left, right), (top, bottom)) = (range(|corner| corner.0), range(|corner| corner.1));
    let box_px = BoxPx {
        x: left,
        y: top,
        width: right - left,
        height: bottom - top,
    };
    // A ray to the left crosses the outline an odd number of times.
    let inside = |column: f64, row: f64| {
        let next = corners.iter().cycle().skip(1);
        let crossed = corners.iter().zip(next).filter(|(a, b)| {
            let passes = (a.1 > row) != (b.1 > row);
            passes && a.0 + (row - a.1) / (b.1 - a.1) * (b.0 - a.0) < column
        });
        crossed.count() % 2 == 1
    };
    (box_px.width > 0.0 && box_px.height > 0.0).then(|| Thing {
        box_px,
        mask: Some(Arc::new(Mask::within(&box_px, inside))),
        score: 1.0,
    })
}

fn read(path: &Path) -> Result<String, DatasetError> {
    std::fs::read_to_string(path).map_err(|source| DatasetError::Read {
        path: path.to_owned(),
        source,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_are_boxes_or_outlines_and_all_else_is_refused() {
        let size = (100.0, 200.0);
        let (class, thing) = label("1 0.5 0.5 0.2 0.1", size).unwrap();
        assert_eq!(class, DetectionClass::Smoke);
        let expected = BoxPx {
            x: 39.5,
            y: 89.5,
            width: 20.0,
            height: 20.0,
        };
        for (found, wanted) in [
            (thing.box_px.x, expected.x),
            (thing.box_px.y, expected.y),
            (thing.box_px.width, expected.width),
            (thing.box_px.height, expected.height),
        ] {
            assert!((found - wanted).abs() < 1e-9, "{:?}", thing.box_px);
        }
        // A right triangle of 10 by 10 pixels: half of them, those on the slanted edge apart.
        let (_, thing) = label("0 0 0 0.1 0 0 0.05", size).unwrap();
        let area = thing.mask.unwrap().area_px();
        assert!((45..=55).contains(&area), "{area}");
        for bad in [
            "",
            "0",
            "9 0.5 0.5 0.1 0.1",
            "0 0.5 0.5 0.1",
            "0 0.5 0.5 0 0.1",
            "0 a b c d",
            "0 NaN 0.5 0.1 0.1",
        ] {
            assert!(label(bad, size).is_none(), "{bad}");
        }
    }
}
