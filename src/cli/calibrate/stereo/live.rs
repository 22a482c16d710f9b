//! The board before a camera: pairs are taken by themselves while it is held still.

use super::StereoArguments;
use super::look::{Looked, Picture};
use crate::cli::Failure;
use crate::ingest::{
    self, CameraUrl, CameraUrlError, Expected, ImageDecoder, StereoPair, stated_size_px,
};
use crate::service::service_clock;
use anyhow::anyhow;
use emberfix_calib::solve::{Board, Corner, View, Wanted, find_corners, make_consistent};
use opencv::core::{Mat, Vector};
use opencv::imgcodecs;
use std::path::Path;
use std::time::{Duration, Instant};

/// Watches until there is enough of everything, the source ends, or the time is up.
pub fn watch(arguments: &StereoArguments, url: &str, board: &Board) -> Result<Looked, Failure> {
    let address: CameraUrl = url
        .parse()
        .map_err(|error: CameraUrlError| Failure::refused(error))?;
    let expected = Expected {
        cameras: None,
        max_skew_s: arguments.live_skew_s,
    };
    let mut source =
        ingest::open(&address, &expected, service_clock()).map_err(Failure::refused)?;
    if let Some(folder) = &arguments.keep {
        std::fs::create_dir_all(folder).map_err(Failure::failed)?;
    }
    let mut watcher = Watcher::new(*board, arguments.live_pairs, arguments.keep.as_deref());
    let end = Instant::now() + Duration::from_secs_f64(arguments.live_limit_s);
    eprintln!(
        "show the board ({}) to both cameras, and hold it still",
        board.words()
    );
    while Instant::now() < end && !watcher.is_content() {
        match source.next_pair() {
            Ok(Some(pair)) => watcher.see(&pair.value)?,
            Ok(None) => break,
            Err(error) if error.is_fatal() => return Err(Failure::failed(error)),
            Err(error) => watcher.say(&format!("waiting: {error}")),
        }
    }
    watcher.finish()
}

/// A board is still when its corners move less than this from one look to the next, pixels, as a mean.
const STILL_PX: f64 = 0.5;
/// A view is new when its corners lie this far from those of every other, as a mean, image widths.
const NEW_WIDTHS: f64 = 0.05;

struct Watcher<'a> {
    board: Board,
    in_all: usize,
    keep: Option<&'a Path>,
    /// Known from the first picture on.
    wanted: Option<Wanted>,
    looked: Looked,
    last: Option<View>,
    said: String,
}

impl<'a> Watcher<'a> {
    fn new(board: Board, in_all: usize, keep: Option<&'a Path>) -> Self {
        Self {
            board,
            in_all,
            keep,
            wanted: None,
            looked: Looked::default(),
            last: None,
            said: String::new(),
        }
    }

    fn is_content(&self) -> bool {
        self.wanted.as_ref().is_some_and(Wanted::is_content)
    }

    /// Says it, unless it was the last thing that was said.
    fn say(&mut self, sentence: &str) {
        if self.said != sentence {
            eprintln!("{sentence}");
            sentence.clone_into(&mut self.said);
        }
    }

    fn see(&mut self, pair: &StereoPair) -> Result<(), Failure> {
        let Some(pictures) = self.pictures(pair)? else {
            return Ok(());
        };
        let find = |image: &Mat| find_corners(image, &self.board).map_err(Failure::failed);
        let (Some(left), Some(right)) = (find(&pictures[0])?, find(&pictures[1])?) else {
            self.last = None;
            self.say("the board is not seen by both cameras");
            return Ok(());
        };
        let name = format!("{:03}", self.looked.views.len() + 1);
        let view = make_consistent(&self.board, View { name, left, right });
        let is_still = self
            .last
            .as_ref()
            .is_some_and(|last| apart_px(&view.left, &last.left) < STILL_PX);
        let is_new = self.is_new(&view);
        self.last = Some(view.clone());
        match (is_still, is_new) {
            (true, true) => self.take(view, pictures)?,
            (true, false) => self.say(&self.ask("this view is there already")),
            (false, _) => self.say("hold the board still"),
        }
        Ok(())
    }

    /// Both eyes in grey; pictures that can't be read are said and skipped.
    fn pictures(&mut self, pair: &StereoPair) -> Result<Option<[Mat; 2]>, Failure> {
        let Some(right) = &pair.right else {
            self.say("only the left camera's picture came");
            return Ok(None);
        };
        let size = match stated_size_px(&pair.left) {
            Ok(size) => size,
            Err(error) => {
                self.say(&error.to_string());
                return Ok(None);
            }
        };
        if self.wanted.is_none() {
            self.wanted = Some(Wanted::new(self.board, size, self.in_all));
            self.looked.size = size;
        }
        if size != self.looked.size {
            return Err(Failure::Failed(anyhow!(
                "a picture has {size:?} pixels, those before had {:?}",
                self.looked.size
            )));
        }
        let mut decoder = ImageDecoder::sized(size, size);
        let decoded = decoder
            .right(&pair.left)
            .and_then(|left| Ok([left, decoder.right(right)?]));
        match decoded {
            Ok(pictures) => Ok(Some(pictures)),
            Err(error) => {
                self.say(&error.to_string());
                Ok(None)
            }
        }
    }

    fn is_new(&self, view: &View) -> bool {
        let least_px = NEW_WIDTHS * f64::from(self.looked.size.0);
        let mut taken = self.looked.views.iter();
        taken.all(|other| apart_px(&view.left, &other.left) > least_px)
    }

    fn take(&mut self, view: View, pictures: [Mat; 2]) -> Result<(), Failure> {
        let Some(wanted) = &mut self.wanted else {
            return Ok(());
        };
        let look = wanted.take(&view).map_err(Failure::failed)?;
        if let Some(folder) = self.keep {
            for (eye, picture) in ["left", "right"].into_iter().zip(&pictures) {
                keep(folder, &format!("{eye}_{}.png", view.name), picture)?;
            }
        }
        let taken = format!("pair {} taken: {look}", view.name);
        self.looked.views.push(view);
        self.looked.shown.push(pictures.map(Picture::Grey));
        self.say(&self.ask(&taken));
        Ok(())
    }

    fn ask(&self, after: &str) -> String {
        let missing = self
            .wanted
            .as_ref()
            .map(Wanted::missing)
            .unwrap_or_default();
        if missing.is_empty() {
            format!("{after}; that is enough")
        } else {
            format!("{after}; still missing: {}", missing.join("; "))
        }
    }

    fn finish(self) -> Result<Looked, Failure> {
        if !self.is_content() {
            let missing = self.wanted.as_ref().map(Wanted::missing);
            eprintln!(
                "ended with {} pairs, still missing: {}",
                self.looked.views.len(),
                missing.map_or("everything".to_owned(), |missing| missing.join("; "))
            );
        }
        Ok(self.looked)
    }
}

fn keep(folder: &Path, name: &str, picture: &Mat) -> Result<(), Failure> {
    let mut bytes = Vector::<u8>::new();
    imgcodecs::imencode_def(".png", picture, &mut bytes).map_err(Failure::failed)?;
    std::fs::write(folder.join(name), bytes.as_slice()).map_err(Failure::failed)
}

/// Mean distance of the corners that both have, pixels; far, if they share none.
fn apart_px(one: &[Corner], other: &[Corner]) -> f64 {
    let (mut sum, mut count) = (0.0, 0_usize);
    for corner in one {
        if let Some(same) = other.iter().find(|same| same.id == corner.id) {
            let (u, v) = (corner.pixel.u - same.pixel.u, corner.pixel.v - same.pixel.v);
            sum += u.hypot(v);
            count += 1;
        }
    }
    if count == 0 {
        return f64::INFINITY;
    }
    sum / count as f64
}
