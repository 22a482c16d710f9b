//! The board in pictures from files.

use super::super::pairs::{self, FilePair};
use crate::cli::Failure;
use anyhow::anyhow;
use emberfix_calib::solve::{Board, Corner, View, find_corners, make_consistent, read_grey};
use indicatif::{ProgressBar, ProgressStyle};
use opencv::core::{Mat, MatTraitConst};
use rayon::prelude::*;
use std::path::{Path, PathBuf};

/// What was seen in the pictures.
#[derive(Default)]
pub struct Looked {
    /// The board in both eyes.
    pub views: Vec<View>,
    /// Pairs without the board, and what was wrong.
    pub unusable: Vec<(String, String)>,
    /// Columns and rows of every picture.
    pub size: (u32, u32),
    /// The pictures of every view: left, right.
    pub shown: Vec<[Picture; 2]>,
}

/// A picture, where it is.
pub enum Picture {
    /// In a file.
    File(PathBuf),
    /// Taken from a camera.
    Grey(Mat),
}

impl Picture {
    fn grey(&self) -> opencv::Result<Option<Mat>> {
        match self {
            Self::File(path) => read_grey(path),
            Self::Grey(image) => Ok(Some(image.try_clone()?)),
        }
    }
}

impl Looked {
    /// Both pictures of a view.
    pub fn pictures(&self, name: &str) -> opencv::Result<Option<(Mat, Mat)>> {
        let Some(at) = self.views.iter().position(|view| view.name == name) else {
            return Ok(None);
        };
        let [left, right] = &self.shown[at];
        Ok(left.grey()?.zip(right.grey()?))
    }
}

type Eye = Result<(Vec<Corner>, (u32, u32)), String>;

/// Finds the pairs, and the board in them.
pub fn look(places: &[PathBuf], board: &Board) -> Result<Looked, Failure> {
    let pairs = file_pairs(places)?;
    let progress = bar(pairs.len() as u64, "looking for the board");
    let found: Vec<(Eye, Eye)> = pairs
        .par_iter()
        .map(|pair| {
            let eyes = (eye(&pair.left, board), eye(&pair.right, board));
            progress.inc(1);
            eyes
        })
        .collect();
    progress.finish_and_clear();
    let mut looked = Looked::default();
    for (pair, eyes) in pairs.into_iter().zip(found) {
        looked.add(pair, eyes, board)?;
    }
    Ok(looked)
}

impl Looked {
    fn add(&mut self, pair: FilePair, eyes: (Eye, Eye), board: &Board) -> Result<(), Failure> {
        match eyes {
            (Ok((left, left_size)), Ok((right, right_size))) => {
                same_size(&pair, &mut self.size, left_size, right_size)?;
                let FilePair {
                    name,
                    left: left_file,
                    right: right_file,
                } = pair;
                let view = View { name, left, right };
                self.views.push(make_consistent(board, view));
                self.shown.push([left_file, right_file].map(Picture::File));
            }
            (Err(why), _) => self.unusable.push((pair.name, format!("left: {why}"))),
            (_, Err(why)) => self.unusable.push((pair.name, format!("right: {why}"))),
        }
        Ok(())
    }
}

fn file_pairs(places: &[PathBuf]) -> Result<Vec<FilePair>, Failure> {
    let files =
        pairs::images(places).map_err(|error| Failure::Refused(anyhow!("images: {error}")))?;
    let pairs = pairs::pair_up(&files);
    if pairs.is_empty() {
        return Err(Failure::Refused(anyhow!(
            "no pairs among {} image files: names need left/right, L/R, cam0/cam1 or nir/vis, and what is \
             left of the name must be the same in both",
            files.len()
        )));
    }
    Ok(pairs)
}

fn eye(path: &Path, board: &Board) -> Eye {
    let in_words = |error: opencv::Error| error.message.replace('\n', " ");
    let image = read_grey(path)
        .map_err(in_words)?
        .ok_or_else(|| format!("{} is no image", path.display()))?;
    let size = (image.cols().unsigned_abs(), image.rows().unsigned_abs());
    match find_corners(&image, board).map_err(in_words)? {
        Some(corners) => Ok((corners, size)),
        None => Err("the board was not found".to_owned()),
    }
}

fn same_size(
    pair: &FilePair,
    size: &mut (u32, u32),
    left: (u32, u32),
    right: (u32, u32),
) -> Result<(), Failure> {
    if *size == (0, 0) {
        *size = left;
    }
    for (path, found) in [(&pair.left, left), (&pair.right, right)] {
        if found != *size {
            return Err(Failure::Refused(anyhow!(
                "{} has {}x{} pixels, others have {}x{}; all pictures need one size",
                path.display(),
                found.0,
                found.1,
                size.0,
                size.1
            )));
        }
    }
    Ok(())
}

fn bar(length: u64, what: &'static str) -> ProgressBar {
    let style = ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len}");
    let bar = ProgressBar::new(length).with_message(what);
    match style {
        Ok(style) => bar.with_style(style),
        Err(_) => bar,
    }
}
