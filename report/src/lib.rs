//! How everything that measures says what it found.
//!
//! **Purpose.** One shape for the figures that `eval`, `demo`, `bench`, `doctor` and `calibrate` print,
//! and one way to draw them. **In:** numbers and bounds; series of points. **Out:** [`Figure`] as JSON
//! and as a line of text; [`Chart`] as SVG and PNG. Pure but for [`Chart::save`] and [`Sheet::save`],
//! which write files.
//!
//! **Known limits.** A PNG is rendered from the SVG with a font of our own, so that it looks the same
//! on every machine; an SVG is shown with the viewer's sans-serif.

mod figure;
mod plot;

pub use figure::{Bound, Figure, text_lines};
pub use plot::{Axis, Chart, Mark, PlotError, Series, Sheet};
