//! Labels: what of a flame or smoke a picture shows, and how it is written down.

use super::outline;
use crate::render::{LabelBox, LabelMask};
use crate::world::BurningClass;

/// A thing cut by the picture's edge to less than this share isn't labelled.
const LEAST_SHARE: f64 = 0.3;
/// Narrower or lower than this isn't labelled, pixels of the picture.
const LEAST_PX: f64 = 2.5;

/// Places as shares of the picture's width and height.
pub(super) struct YoloLabel {
    pub class: BurningClass,
    left: f64,
    top: f64,
    right: f64,
    bottom: f64,
    /// Corners, where outlines are asked for.
    outline: Vec<(f64, f64)>,
}

impl YoloLabel {
    pub(super) fn line(&self) -> String {
        let class = match self.class {
            BurningClass::Fire => 0,
            BurningClass::Smoke => 1,
        };
        if !self.outline.is_empty() {
            let corner = |(x, y): &(f64, f64)| format!(" {x:.6} {y:.6}");
            let corners: String = self.outline.iter().map(corner).collect();
            return format!("{class}{corners}\n");
        }
        let (cx, cy) = (
            0.5 * (self.left + self.right),
            0.5 * (self.top + self.bottom),
        );
        let (width, height) = (self.right - self.left, self.bottom - self.top);
        format!("{class} {cx:.6} {cy:.6} {width:.6} {height:.6}\n")
    }
}

/// How raw pixels become pixels of the picture: `picture = raw * scale + shift`.
pub(super) struct Window {
    pub scale: f64,
    pub shift: (f64, f64),
    /// Columns and rows of the picture.
    pub size: (f64, f64),
    /// Rows of the picture that hold the image; columns always do.
    pub rows: (f64, f64),
    /// First column and row that it shows, raw pixels.
    pub raw_first: (u32, u32),
    /// How many of them.
    pub raw_size: (u32, u32),
}

impl Window {
    pub(super) fn label(&self, mask: &LabelMask, outlines: bool) -> Option<YoloLabel> {
        let boxed = self.boxed(&mask.label)?;
        if outlines {
            self.outlined(mask, boxed)
        } else {
            Some(boxed)
        }
    }

    fn boxed(&self, label: &LabelBox) -> Option<YoloLabel> {
        let (width, height) = self.size;
        // Half a pixel: label edges count from the first pixel's centre, shares from its edge.
        let across = |px: f64| (px + 0.5) * self.scale + self.shift.0;
        let down = |px: f64| (px + 0.5) * self.scale + self.shift.1;
        let whole = (label.right_px - label.left_px)
            * (label.bottom_px - label.top_px)
            * self.scale.powi(2);
        let (left, right) = (
            across(label.left_px).max(0.0),
            across(label.right_px).min(width),
        );
        let (top, bottom) = (
            down(label.top_px).max(self.rows.0),
            down(label.bottom_px).min(self.rows.1),
        );
        let seen = (right - left).max(0.0) * (bottom - top).max(0.0);
        let big = right - left >= LEAST_PX && bottom - top >= LEAST_PX;
        (big && seen >= LEAST_SHARE * whole).then(|| YoloLabel {
            class: label.class,
            left: left / width,
            top: top / height,
            right: right / width,
            bottom: bottom / height,
            outline: Vec::new(),
        })
    }

    /// Around the pixels that the picture shows; the box, too.
    fn outlined(&self, mask: &LabelMask, boxed: YoloLabel) -> Option<YoloLabel> {
        let (first, (columns, rows)) = (self.raw_first, self.raw_size);
        let covers = |x: u32, y: u32| mask.covers(first.0 + x, first.1 + y);
        let share = |(x, y): outline::Corner| {
            let at =
                |start: u32, step: u32, shift: f64| f64::from(start + step) * self.scale + shift;
            (
                at(first.0, x, self.shift.0) / self.size.0,
                at(first.1, y, self.shift.1) / self.size.1,
            )
        };
        let outline: Vec<(f64, f64)> = outline::outline(columns, rows, covers)
            .into_iter()
            .map(share)
            .collect();
        let range = |of: fn(&(f64, f64)) -> f64| {
            let low = outline.iter().map(of).fold(f64::INFINITY, f64::min);
            (
                low,
                outline.iter().map(of).fold(f64::NEG_INFINITY, f64::max),
            )
        };
        let ((left, right), (top, bottom)) = (range(|corner| corner.0), range(|corner| corner.1));
        let big =
            (right - left) * self.size.0 >= LEAST_PX && (bottom - top) * self.size.1 >= LEAST_PX;
        big.then_some(YoloLabel {
            class: boxed.class,
            left,
            top,
            right,
            bottom,
            outline,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_label_follows_its_window_and_is_dropped_when_little_of_it_is_left() {
        let window = Window {
            scale: 1.0,
            shift: (-100.0, -50.0),
            size: (416.0, 416.0),
            rows: (0.0, 416.0),
            raw_first: (100, 50),
            raw_size: (416, 416),
        };
        let label = |left_px: f64| LabelBox {
            class: BurningClass::Fire,
            fire: 0,
            left_px,
            top_px: 99.5,
            right_px: left_px + 40.0,
            bottom_px: 149.5,
        };
        let inside = window.boxed(&label(199.5)).unwrap();
        assert!((inside.left * 416.0 - 100.0).abs() < 1e-9);
        assert!((inside.bottom * 416.0 - 100.0).abs() < 1e-9);
        assert!(
            window.boxed(&label(65.0)).is_none(),
            "a fifth of it is left"
        );
        assert!(window.boxed(&label(80.0)).is_some(), "half of it is left");
    }
}
