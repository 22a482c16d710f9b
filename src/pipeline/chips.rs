//! Pictures of fires: which look is worth one, and what of it is shown.
//!
//! **When.** When a fire is first told, when it begins to grow, and when a look shows it much larger than
//! the picture that people have ([`BETTER`]). **What.** The left image about its box, at most
//! [`SIDE_PX`] wide and high. Cut out here, encoded by [`Chip::jpeg`] at the edge, once the alarm itself is
//! on disk.

use crate::alarm::{FireId, FireState};
use crate::detect::BoxPx;
use emberfix_frames::{ServiceTime, SignedDuration};
use opencv::core::{Mat, MatTraitConst, Rect, Size, Vector};
use opencv::{imgcodecs, imgproc};
use std::collections::BTreeMap;

/// Largest picture, bytes: nine seconds of a link that gives pictures 500 B/s.
pub const MAX_BYTES: usize = 4_096;
/// Largest side, pixels.
const SIDE_PX: i32 = 160;
/// Least part of the image that is shown, pixels: what burns is told by what stands about it.
const LEAST_PX: f64 = 64.0;
/// Margin on each side, as a share of the box.
const MARGIN: f64 = 0.6;
/// A box of so many times the area of the last picture's deserves another.
const BETTER: f64 = 2.0;
/// Between two pictures of a fire whose state is the same.
const PAUSE: SignedDuration = SignedDuration::from_secs(20);
/// Qualities that are tried, best first.
const QUALITIES: [i32; 4] = [80, 60, 45, 30];
/// Times that a picture is halved when no quality makes it small enough: noise.
const HALVINGS: u32 = 3;

/// A fire's picture, cut out.
#[derive(Debug, Clone)]
pub struct Chip {
    /// Alarm id.
    pub id: String,
    /// The alarm's newest revision.
    pub revision: u32,
    /// Mid-exposure.
    pub at: ServiceTime,
    bgr: Mat,
}

impl Chip {
    /// As JPEG of at most [`MAX_BYTES`]; none where OpenCV or the picture won't have it.
    #[must_use]
    pub fn jpeg(&self) -> Option<Vec<u8>> {
        let mut bgr = self.bgr.clone();
        for _ in 0..=HALVINGS {
            for quality in QUALITIES {
                let bytes = encode(&bgr, quality).ok()?;
                if bytes.len() <= MAX_BYTES {
                    return Some(bytes);
                }
            }
            bgr = scaled(&bgr, 0.5).ok()?;
        }
        None
    }
}

/// What the last picture of each fire showed.
#[derive(Debug, Default)]
pub(super) struct Gallery(BTreeMap<FireId, Shown>);

#[derive(Debug, Clone, Copy)]
struct Shown {
    revision: u32,
    state: FireState,
    area_px2: f64,
    at: ServiceTime,
}

/// What a look at a told fire offers.
#[derive(Debug, Clone, Copy)]
pub(super) struct Offer {
    pub fire: FireId,
    /// Newest revision and state that were told.
    pub told: (u32, FireState),
    /// Pixels of the raw left image.
    pub box_px: BoxPx,
    /// Mid-exposure.
    pub at: ServiceTime,
}

impl Gallery {
    /// Whether this look is worth a picture; then it counts as shown.
    pub fn takes(&mut self, offer: &Offer) -> bool {
        let (revision, state) = offer.told;
        let area_px2 = offer.box_px.width * offer.box_px.height;
        let due = self.0.get(&offer.fire).is_none_or(|shown| {
            let grew = state == FireState::Growing && shown.state != FireState::Growing;
            let better = area_px2 >= BETTER * shown.area_px2 && offer.at - shown.at >= PAUSE;
            // The ground keeps one picture of a revision.
            revision > shown.revision && (grew || better)
        });
        if due {
            let shown = Shown {
                revision,
                state,
                area_px2,
                at: offer.at,
            };
            self.0.insert(offer.fire, shown);
        }
        due
    }

    /// Forgets fires that are no more.
    pub fn keep(&mut self, is_there: impl Fn(FireId) -> bool) {
        self.0.retain(|fire, _| is_there(*fire));
    }
}

/// Cuts a fire out of the left image.
pub(super) fn cut(
    left_bgr: &Mat,
    box_px: &BoxPx,
    (id, revision): (String, u32),
    at: ServiceTime,
) -> opencv::Result<Chip> {
    let part = Mat::roi(left_bgr, about(box_px, left_bgr.size()?))?;
    let longest = part.cols().max(part.rows());
    let scale = f64::from(SIDE_PX) / f64::from(longest.max(1));
    let bgr = if scale < 1.0 {
        scaled(&part, scale)?
    } else {
        part.try_clone()?
    };
    Ok(Chip {
        id,
        revision,
        at,
        bgr,
    })
}

/// The box with its margin, within the image; never empty.
fn about(box_px: &BoxPx, image: Size) -> Rect {
    let side = |from: f64, length: f64, limit: i32| {
        let wanted = (length * (1.0 + 2.0 * MARGIN)).max(LEAST_PX);
        let size = (wanted.round() as i32).clamp(1, limit.max(1));
        let begin = (from + length / 2.0 - f64::from(size) / 2.0).round() as i32;
        (begin.clamp(0, limit - size), size)
    };
    let (x, width) = side(box_px.x, box_px.width, image.width);
    let (y, height) = side(box_px.y, box_px.height, image.height);
    Rect::new(x, y, width, height)
}

fn scaled(bgr: &impl opencv::core::ToInputArray, scale: f64) -> opencv::Result<Mat> {
    let mut small = Mat::default();
    imgproc::resize(
        bgr,
        &mut small,
        Size::default(),
        scale,
        scale,
        imgproc::INTER_AREA,
    )?;
    Ok(small)
}

fn encode(bgr: &Mat, quality: i32) -> opencv::Result<Vec<u8>> {
    let mut bytes = Vector::new();
    let settings = Vector::from_slice(&[imgcodecs::IMWRITE_JPEG_QUALITY, quality]);
    imgcodecs::imencode(".jpg", bgr, &mut bytes, &settings)?;
    Ok(bytes.into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use opencv::core::{CV_8UC3, Scalar, Vec3b};
    use opencv::prelude::MatTraitConstManual;
    use rand::{Rng as _, SeedableRng as _};

    const AT: ServiceTime = ServiceTime::from_unix_ns(1_772_366_400_000_000_000);

    fn boxed(x: f64, y: f64, width: f64, height: f64) -> BoxPx {
        BoxPx {
            x,
            y,
            width,
            height,
        }
    }

    fn cut_of(image: &Mat, box_px: &BoxPx) -> Chip {
        cut(image, box_px, ("uav-1-1".to_owned(), 3), AT).unwrap()
    }

    /// Dark green, and something orange in `box_px`.
    fn scene(box_px: &BoxPx) -> Mat {
        let green = Scalar::new(20.0, 60.0, 20.0, 0.0);
        let mut image = Mat::new_rows_cols_with_default(720, 1280, CV_8UC3, green).unwrap();
        let flame = Rect::new(
            box_px.x as i32,
            box_px.y as i32,
            box_px.width as i32,
            box_px.height as i32,
        );
        let orange = Scalar::new(30.0, 140.0, 250.0, 0.0);
        imgproc::rectangle(
            &mut image,
            flame,
            orange,
            imgproc::FILLED,
            imgproc::LINE_8,
            0,
        )
        .unwrap();
        image
    }

    #[test]
    fn what_burns_stands_in_the_middle_of_a_small_jpeg() {
        for box_px in [
            boxed(600.0, 300.0, 40.0, 60.0),
            boxed(100.0, 100.0, 500.0, 400.0),
            boxed(640.0, 360.0, 12.0, 12.0),
        ] {
            let jpeg = cut_of(&scene(&box_px), &box_px).jpeg().unwrap();
            assert!(jpeg.len() <= MAX_BYTES, "{} bytes", jpeg.len());
            let seen = image::load_from_memory(&jpeg).unwrap().to_rgb8();
            assert!(seen.width().max(seen.height()) <= 160);
            let middle = seen.get_pixel(seen.width() / 2, seen.height() / 2).0;
            assert!(middle[0] > 200 && middle[2] < 90, "{middle:?}");
            let corner = seen.get_pixel(0, 0).0;
            assert!(corner[0] < 60, "with what stands about it: {corner:?}");
        }
    }

    #[test]
    fn a_box_at_the_edge_or_out_of_the_image_is_cut_within_it() {
        let image = scene(&boxed(0.0, 0.0, 50.0, 50.0));
        for box_px in [
            boxed(0.0, 0.0, 50.0, 50.0),
            boxed(-30.0, 700.0, 60.0, 60.0),
            boxed(5_000.0, -5_000.0, 10.0, 10.0),
            boxed(0.0, 0.0, 1e9, 1e9),
            boxed(f64::NAN, f64::NAN, f64::NAN, f64::NAN),
        ] {
            let jpeg = cut_of(&image, &box_px).jpeg().unwrap();
            assert!(image::load_from_memory(&jpeg).is_ok(), "{box_px:?}");
        }
    }

    #[test]
    fn noise_is_made_small_enough_too() {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(5);
        let pixels: Vec<Vec3b> = (0..200 * 200)
            .map(|_| Vec3b::from(random.random::<[u8; 3]>()))
            .collect();
        let image = Mat::from_slice(&pixels)
            .unwrap()
            .reshape(3, 200)
            .unwrap()
            .try_clone()
            .unwrap();
        let jpeg = cut_of(&image, &boxed(20.0, 20.0, 160.0, 160.0))
            .jpeg()
            .unwrap();
        assert!(jpeg.len() <= MAX_BYTES, "{} bytes", jpeg.len());
        assert_eq!(image.data_bytes().unwrap().len(), 120_000);
    }

    #[test]
    fn a_fire_is_shown_when_first_told_when_it_grows_and_when_it_is_seen_much_better() {
        let mut gallery = Gallery::default();
        let mut look = |revision, state, side: f64, at_s| {
            gallery.takes(&Offer {
                fire: FireId(1),
                told: (revision, state),
                box_px: boxed(0.0, 0.0, side, side),
                at: AT + SignedDuration::from_secs(at_s),
            })
        };
        assert!(look(1, FireState::Confirmed, 20.0, 0));
        assert!(!look(1, FireState::Growing, 20.0, 1), "no newer revision");
        assert!(look(2, FireState::Growing, 20.0, 2));
        assert!(!look(3, FireState::Growing, 40.0, 10), "too soon");
        assert!(!look(4, FireState::Growing, 24.0, 30), "not much better");
        assert!(look(5, FireState::Growing, 30.0, 31));
        assert!(!look(6, FireState::Dying, 30.0, 60));
    }
}
