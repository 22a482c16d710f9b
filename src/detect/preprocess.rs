//! The views that a detector takes of one image, their pixels as the network wants them, and the
//! exact way back.
//!
//! The whole frame is letter-boxed into the input (grey bars of 114, as in training); tiles at their
//! own resolution cover the frame as well, so that a small flame keeps its pixels.

use super::BoxPx;
use super::family::{Colour, InputBox, InputSize, Normalisation};
use super::mask::{Mask, MaskLogits};
use opencv::core::{
    self, CV_32FC1, Mat, MatTrait, MatTraitConst, Rect, Size, ToInputArray, Vector,
};
use opencv::imgproc;
use std::ops::Range;

/// Grey of the bars, as in training.
const BAR: f32 = 114.0;

/// Edges nearer than this to a view's border, in input pixels, are cut by it.
const CUT_MARGIN_PX: f64 = 3.0;

/// One cut-out of the image and how it lies in the network's input.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct View {
    /// Cut-out, raw pixels.
    source: Source,
    /// Input pixels per raw pixel along columns and rows (they differ by rounding alone).
    scale: (f64, f64),
    /// Width and height of the scaled cut-out, input pixels.
    fitted: (usize, usize),
    /// Grey bar left of it and above it, input pixels.
    offset: (usize, usize),
    image: (u32, u32),
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Source {
    x: u32,
    y: u32,
    width: u32,
    height: u32,
}

/// What a view sees, in the raw image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Seen {
    pub box_px: BoxPx,
    /// It ends at a border of the view that is not the image's.
    pub cut: bool,
}

impl View {
    fn new(source: Source, input: InputSize, image: (u32, u32)) -> Self {
        let (width, height) = (f64::from(source.width), f64::from(source.height));
        let scale = (input.width as f64 / width).min(input.height as f64 / height);
        let fitted = |length: f64| ((length * scale).round() as usize).max(1);
        let (columns, rows) = (fitted(width), fitted(height));
        Self {
            source,
            scale: (columns as f64 / width, rows as f64 / height),
            fitted: (columns, rows),
            offset: ((input.width - columns) / 2, (input.height - rows) / 2),
            image,
        }
    }

    /// The part of the raw image that it shows: columns, rows.
    pub fn extent(&self) -> (Range<f64>, Range<f64>) {
        let Source {
            x,
            y,
            width,
            height,
        } = self.source;
        let range = |from: u32, length: u32| f64::from(from)..f64::from(from + length);
        (range(x, width), range(y, height))
    }

    /// Input pixels per raw pixel.
    pub fn scale(&self) -> f64 {
        self.scale.0
    }

    /// A box of the network in the raw image (pixel centres at whole numbers), clamped to it;
    /// `None` when nothing of it is left.
    pub fn to_raw(self, found: &InputBox) -> Option<Seen> {
        let (left, right) = (self.column(found.left), self.column(found.right));
        let (top, bottom) = (self.row(found.top), self.row(found.bottom));
        let last = (f64::from(self.image.0) - 1.0, f64::from(self.image.1) - 1.0);
        let (x, y) = (left.max(0.0), top.max(0.0));
        let (width, height) = (right.min(last.0) - x, bottom.min(last.1) - y);
        let edges = [left, top, right, bottom];
        if edges.iter().any(|edge| !edge.is_finite()) || width <= 0.0 || height <= 0.0 {
            return None;
        }
        let cut = self.cuts(edges);
        Some(Seen {
            box_px: BoxPx {
                x,
                y,
                width,
                height,
            },
            cut,
        })
    }

    /// A mask of the network in the raw image, within a box of it.
    pub fn mask_to_raw(self, logits: &MaskLogits, box_px: &BoxPx) -> Mask {
        let across = |column: f64| {
            (column + 0.5 - f64::from(self.source.x)) * self.scale.0 + self.offset.0 as f64
        };
        let down =
            |row: f64| (row + 0.5 - f64::from(self.source.y)) * self.scale.1 + self.offset.1 as f64;
        Mask::within(box_px, |column, row| {
            logits.covers(across(column), down(row))
        })
    }

    fn column(&self, edge: f32) -> f64 {
        let fitted = f64::from(edge) - self.offset.0 as f64;
        f64::from(self.source.x) + fitted / self.scale.0 - 0.5
    }

    fn row(&self, edge: f32) -> f64 {
        let fitted = f64::from(edge) - self.offset.1 as f64;
        f64::from(self.source.y) + fitted / self.scale.1 - 0.5
    }

    /// Whether a border inside the image ends these raw edges (left, top, right, bottom).
    fn cuts(&self, edges: [f64; 4]) -> bool {
        let Source {
            x,
            y,
            width,
            height,
        } = self.source;
        let (right, bottom) = (x + width, y + height);
        let margin = CUT_MARGIN_PX / self.scale.0;
        (x > 0 && edges[0] < f64::from(x) + margin)
            || (y > 0 && edges[1] < f64::from(y) + margin)
            || (right < self.image.0 && edges[2] > f64::from(right) - margin)
            || (bottom < self.image.1 && edges[3] > f64::from(bottom) - margin)
    }
}

/// The views of an image of this size: the whole frame, then tiles of `tile_px` that overlap by at
/// least `overlap_px` and lie evenly. No tiles where one view shows every pixel already.
pub(super) fn plan(
    image: (u32, u32),
    input: InputSize,
    tile_px: Option<u32>,
    overlap_px: u32,
) -> Vec<View> {
    let (width, height) = image;
    let mut views = vec![View::new(
        Source {
            x: 0,
            y: 0,
            width,
            height,
        },
        input,
        image,
    )];
    if let Some(tile) =
        tile_px.filter(|tile| views[0].scale() < 1.0 && (width > *tile || height > *tile))
    {
        for y in starts(height, tile, overlap_px) {
            for x in starts(width, tile, overlap_px) {
                let source = Source {
                    x,
                    y,
                    width: tile.min(width),
                    height: tile.min(height),
                };
                views.push(View::new(source, input, image));
            }
        }
    }
    views
}

/// First pixels of evenly laid tiles along one side.
fn starts(length: u32, tile: u32, overlap: u32) -> Vec<u32> {
    if length <= tile {
        return vec![0];
    }
    let step = tile.saturating_sub(overlap).max(1);
    let gaps = (length - tile).div_ceil(step);
    (0..=gaps).map(|k| (length - tile) * k / gaps).collect()
}

/// Fills the network's input, and keeps what it needs between views.
pub(super) struct Painter {
    input: InputSize,
    gain: [f32; 3],
    shift: [f32; 3],
    /// Channel of the BGR image that each channel of the input shows.
    channel: [usize; 3],
    scaled: Mat,
    /// The channels of what is painted, one by one.
    channels: Vector<Mat>,
    /// Batch 1, channels, rows, columns.
    pub tensor: Vec<f32>,
}

impl Painter {
    pub fn new(input: InputSize, normalisation: Normalisation) -> Self {
        let Normalisation { colour, mean, std } = normalisation;
        Self {
            input,
            gain: std.map(|std| 1.0 / std),
            shift: [0, 1, 2].map(|c| -mean[c] / std[c]),
            channel: match colour {
                Colour::Bgr => [0, 1, 2],
                Colour::Rgb => [2, 1, 0],
            },
            scaled: Mat::default(),
            channels: Vector::new(),
            tensor: vec![0.0; 3 * input.width * input.height],
        }
    }

    /// Paints a view of an 8-bit BGR image into the tensor.
    pub fn paint(&mut self, bgr: &Mat, view: &View) -> opencv::Result<()> {
        let Source {
            x,
            y,
            width,
            height,
        } = view.source;
        let cutout = bgr.roi(Rect::new(x as i32, y as i32, width as i32, height as i32))?;
        if view.fitted == (width as usize, height as usize) {
            return self.fill(&cutout, view);
        }
        let size = Size::new(view.fitted.0 as i32, view.fitted.1 as i32);
        let way = if view.scale() < 1.0 {
            imgproc::INTER_AREA
        } else {
            imgproc::INTER_LINEAR
        };
        let mut scaled = std::mem::take(&mut self.scaled);
        imgproc::resize(&cutout, &mut scaled, size, 0.0, 0.0, way)?;
        let filled = self.fill(&scaled, view);
        self.scaled = scaled;
        filled
    }

    fn fill(
        &mut self,
        fitted: &(impl MatTraitConst + ToInputArray),
        view: &View,
    ) -> opencv::Result<()> {
        let (columns, rows) = view.fitted;
        if (columns, rows) != (self.input.width, self.input.height) {
            self.fill_bars();
        }
        core::split(fitted, &mut self.channels)?;
        let (width, height) = (self.input.width, self.input.height);
        let at = Rect::new(
            view.offset.0 as i32,
            view.offset.1 as i32,
            columns as i32,
            rows as i32,
        );
        for (c, plane) in self.tensor.chunks_exact_mut(width * height).enumerate() {
            let (gain, shift) = (f64::from(self.gain[c]), f64::from(self.shift[c]));
            let channel = self.channels.get(self.channel[c])?;
            let mut plane = Mat::new_rows_cols_with_data_mut(height as i32, width as i32, plane)?;
            channel.convert_to(&mut plane.roi_mut(at)?, CV_32FC1, gain, shift)?;
        }
        Ok(())
    }

    fn fill_bars(&mut self) {
        let plane = self.input.width * self.input.height;
        for (c, values) in self.tensor.chunks_exact_mut(plane).enumerate() {
            values.fill(BAR * self.gain[c] + self.shift[c]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use opencv::core::{CV_8UC3, Scalar, Vec3b};

    const INPUT: InputSize = InputSize {
        width: 416,
        height: 416,
    };
    const PLAIN: Normalisation = Normalisation {
        colour: Colour::Bgr,
        mean: [0.0; 3],
        std: [1.0; 3],
    };

    fn of(left: f32, top: f32, right: f32, bottom: f32) -> InputBox {
        InputBox {
            class: 0,
            score: 1.0,
            left,
            top,
            right,
            bottom,
            row: 0,
        }
    }

    /// The same edge of the input, once as a box and once as a mask, is the same edge of the image.
    #[test]
    fn masks_come_back_to_where_boxes_do() {
        for view in plan((1280, 720), INPUT, Some(416), 96) {
            // Grid pixels of 4: logits change sign at column 200 of the input.
            let values = |k: usize| if k % 104 < 50 { 1.0 } else { -1.0 };
            let logits = MaskLogits {
                columns: 104,
                rows: 104,
                stride: (4.0, 4.0),
                values: (0..104 * 104).map(values).collect(),
            };
            let seen = view.to_raw(&of(180.0, 180.0, 220.0, 220.0)).unwrap().box_px;
            let edge = view.to_raw(&of(180.0, 180.0, 200.0, 220.0)).unwrap().box_px;
            let mask = view.mask_to_raw(&logits, &seen);
            let last = mask.pixels().map(|(column, _)| column).max().unwrap();
            let edge = edge.x + edge.width;
            assert!(
                (edge - 1.0..=edge).contains(&f64::from(last)),
                "{last} {edge}"
            );
        }
    }

    #[test]
    fn tiles_cover_every_pixel_and_overlap_as_asked() {
        let views = plan((1280, 720), INPUT, Some(416), 96);
        assert_eq!(views.len(), 1 + 4 * 2);
        for length in [417_u32, 720, 1280, 1920, 3840] {
            let starts = starts(length, 416, 96);
            assert_eq!((starts[0], starts[starts.len() - 1]), (0, length - 416));
            assert!(
                starts
                    .windows(2)
                    .all(|pair| pair[1] > pair[0] && pair[1] - pair[0] <= 320)
            );
        }
    }

    #[test]
    fn an_image_that_fits_the_input_is_seen_once() {
        assert_eq!(plan((416, 300), INPUT, Some(416), 96).len(), 1);
        assert_eq!(plan((1280, 720), INPUT, None, 96).len(), 1);
    }

    /// Marks single raw pixels, paints them, looks for them in the tensor and maps back.
    #[test]
    fn a_pixel_is_found_where_the_way_back_says_it_was() {
        for view in plan((1280, 720), INPUT, Some(416), 96) {
            let (u, v) = (view.source.x + 201, view.source.y + 333);
            let mut image =
                Mat::new_rows_cols_with_default(720, 1280, CV_8UC3, Scalar::all(0.0)).unwrap();
            // A block as large as a few input pixels, so that scaling down keeps its middle.
            for row in v as i32 - 8..=v as i32 + 8 {
                for column in u as i32 - 8..=u as i32 + 8 {
                    *image.at_2d_mut::<Vec3b>(row, column).unwrap() = Vec3b::from([0, 0, 250]);
                }
            }
            let mut painter = Painter::new(INPUT, PLAIN);
            painter.paint(&image, &view).unwrap();
            let red = &painter.tensor[2 * 416 * 416..];
            let (mut sum, mut column, mut row) = (0.0, 0.0, 0.0);
            for (index, value) in red.iter().enumerate().filter(|(_, value)| **value != 114.0) {
                sum += f64::from(*value);
                column += f64::from(*value) * ((index % 416) as f64 + 0.5);
                row += f64::from(*value) * ((index / 416) as f64 + 0.5);
            }
            let (column, row) = ((column / sum) as f32, (row / sum) as f32);
            let raw = view
                .to_raw(&of(column - 1.0, row - 1.0, column + 1.0, row + 1.0))
                .unwrap();
            let (found_u, found_v) = raw.box_px.centre();
            // 8-bit rounding of the block's rim, seen through a scale of 0.325.
            assert!(
                (found_u - f64::from(u)).abs() < 0.05,
                "{view:?}: {found_u} {u}"
            );
            assert!(
                (found_v - f64::from(v)).abs() < 0.05,
                "{view:?}: {found_v} {v}"
            );
        }
    }

    #[test]
    fn bars_are_grey_and_pixels_are_normalised_in_the_models_order() {
        let image =
            Mat::new_rows_cols_with_default(720, 1280, CV_8UC3, Scalar::from((10.0, 20.0, 30.0)))
                .unwrap();
        let rgb = Normalisation {
            colour: Colour::Rgb,
            mean: [1.0, 2.0, 3.0],
            std: [2.0, 4.0, 8.0],
        };
        let mut painter = Painter::new(INPUT, rgb);
        painter
            .paint(&image, &plan((1280, 720), INPUT, None, 0)[0])
            .unwrap();
        let plane = 416 * 416;
        let middle = 208 * 416 + 208;
        let values = [0, 1, 2].map(|c| painter.tensor[c * plane + middle]);
        assert_eq!(
            values,
            [(30.0 - 1.0) / 2.0, (20.0 - 2.0) / 4.0, (10.0 - 3.0) / 8.0]
        );
        assert_eq!(painter.tensor[0], (114.0 - 1.0) / 2.0);
        // 720 * 0.325 = 234 rows of image between two bars of 91.
        assert_eq!(painter.tensor[90 * 416], (114.0 - 1.0) / 2.0);
        assert_eq!(painter.tensor[91 * 416], (30.0 - 1.0) / 2.0);
    }

    #[test]
    fn boxes_are_clamped_to_the_image_and_empty_ones_dropped() {
        let whole = plan((1280, 720), INPUT, None, 0)[0];
        let clamped = whole.to_raw(&of(-50.0, 0.0, 500.0, 500.0)).unwrap().box_px;
        assert_eq!(
            clamped,
            BoxPx {
                x: 0.0,
                y: 0.0,
                width: 1279.0,
                height: 719.0
            }
        );
        for nothing in [
            of(10.0, 100.0, 10.0, 120.0),
            of(20.0, 120.0, 10.0, 100.0),
            of(500.0, 200.0, 600.0, 300.0),
            of(f32::NAN, 100.0, 20.0, 120.0),
        ] {
            assert_eq!(whole.to_raw(&nothing), None, "{nothing:?}");
        }
    }

    #[test]
    fn only_borders_inside_the_image_cut() {
        let views = plan((1280, 720), INPUT, Some(416), 96);
        let top_left = views[1];
        assert!(!top_left.to_raw(&of(0.0, 0.0, 50.0, 50.0)).unwrap().cut);
        assert!(
            top_left
                .to_raw(&of(300.0, 100.0, 416.0, 200.0))
                .unwrap()
                .cut
        );
        assert!(!views[0].to_raw(&of(0.0, 100.0, 416.0, 200.0)).unwrap().cut);
    }
}
