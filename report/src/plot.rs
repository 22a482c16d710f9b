//! Charts and sheets of charts, as SVG and PNG.

use plotters::coord::Shift;
use plotters::coord::combinators::BindKeyPoints;
use plotters::coord::ranged1d::{AsRangedCoord, Ranged, ValueFormatter};
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;
use resvg::{tiny_skia, usvg};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Points of one kind.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// Its name in the legend; an empty one is not listed.
    pub label: String,
    /// How it is drawn.
    pub mark: Mark,
    /// Points (x, y). What is not finite, or not positive on a logarithmic axis, is left out.
    pub points: Vec<(f64, f64)>,
}

/// How a series is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mark {
    /// A line through the points.
    Line,
    /// A dashed line through the points: bounds, references.
    Dashed,
    /// A dot at each point.
    Dots,
    /// A line with a dot at each point.
    LineAndDots,
    /// A line from each first to each second of two points: intervals.
    Spans,
}

impl Series {
    /// A named series.
    #[must_use]
    pub fn new(label: impl Into<String>, mark: Mark, points: Vec<(f64, f64)>) -> Self {
        Self {
            label: label.into(),
            mark,
            points,
        }
    }
}

/// One axis.
#[derive(Debug, Clone, PartialEq)]
pub struct Axis {
    /// What it is, with its unit: "range, m".
    pub label: String,
    /// Logarithmic.
    pub log: bool,
    /// Limits; from the points when there are none.
    pub limits: Option<(f64, f64)>,
    /// What stands at 0, -1, -2 and so on, in place of numbers: on a vertical axis from the top down.
    pub names: Vec<String>,
}

impl Axis {
    /// A linear axis that fits the points.
    #[must_use]
    pub fn linear(label: impl Into<String>) -> Self {
        Self {
            label: label.into(),
            log: false,
            limits: None,
            names: Vec::new(),
        }
    }

    /// A vertical axis of names, the first at 0 on top, the next at -1, and so on.
    #[must_use]
    pub fn named(names: Vec<String>) -> Self {
        let rows = names.len().max(1) as f64;
        Self {
            names,
            ..Self::linear("").within(0.5 - rows, 0.5 + LEGEND_ROWS * rows)
        }
    }

    /// A logarithmic axis that fits the points.
    #[must_use]
    pub fn log(label: impl Into<String>) -> Self {
        Self {
            log: true,
            ..Self::linear(label)
        }
    }

    /// With given limits.
    #[must_use]
    pub fn within(self, low: f64, high: f64) -> Self {
        Self {
            limits: Some((low, high)),
            ..self
        }
    }

    fn shows(&self, value: f64) -> bool {
        value.is_finite() && (!self.log || value > 0.0)
    }

    /// From least to greatest, with some air.
    fn range(&self, values: impl Iterator<Item = f64>) -> Range<f64> {
        if let Some((low, high)) = self.limits {
            return low..high;
        }
        let (low, high) = values
            .filter(|value| self.shows(*value))
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| {
                (low.min(value), high.max(value))
            });
        if low > high {
            return if self.log { 0.1..10.0 } else { 0.0..1.0 };
        }
        if self.log {
            return low / 1.2..high * 1.2;
        }
        let air = ((high - low) * 0.05).max(high.abs() * 1e-3).max(1e-9);
        low - air..high + air
    }

    /// Where the ticks of a logarithmic axis are: at 1, 2, 5, 10 and so on, or closer on a short one.
    fn log_ticks(&self, range: &Range<f64>) -> Vec<f64> {
        if range.end < 3.0 * range.start {
            return RangedCoordf64::from(range.clone()).key_points(TICKS);
        }
        let decades = (range.start.log10().floor() as i32)..=(range.end.log10().ceil() as i32);
        let of = |decade: i32| [1.0, 2.0, 5.0].map(|leading| leading * 10_f64.powi(decade));
        decades
            .flat_map(of)
            .filter(|value| range.contains(value))
            .collect()
    }

    /// Ticks at most of an axis that is not logarithmic.
    fn most_ticks(&self) -> usize {
        match self.names.len() {
            0 => TICKS,
            rows => (rows as f64 * (1.0 + LEGEND_ROWS)) as usize,
        }
    }

    /// What stands at a tick.
    fn tick(&self, value: f64) -> String {
        if self.names.is_empty() {
            return short(value);
        }
        let row = -value.round();
        let name = (row >= 0.0).then(|| self.names.get(row as usize)).flatten();
        name.cloned().unwrap_or_default()
    }

    /// Room for what stands at its ticks, pixels.
    fn room_px(&self) -> u32 {
        let longest = self.names.iter().map(|name| name.chars().count()).max();
        longest.map_or(NUMBERS_PX, |letters| letters as u32 * LETTER_PX + 16)
    }

    /// How far along the axis a value is, 0 to 1.
    fn share(&self, value: f64, range: &Range<f64>) -> f64 {
        let scaled = |value: f64| if self.log { value.ln() } else { value };
        let (low, high) = (scaled(range.start), scaled(range.end));
        (scaled(value) - low) / (high - low)
    }
}

/// One chart.
#[derive(Debug, Clone, PartialEq)]
pub struct Chart {
    /// What it shows.
    pub title: String,
    /// Horizontal axis.
    pub x: Axis,
    /// Vertical axis.
    pub y: Axis,
    /// What is drawn, in this order.
    pub series: Vec<Series>,
}

/// Charts in a grid, row by row.
#[derive(Debug, Clone, PartialEq)]
pub struct Sheet {
    /// Charts.
    pub charts: Vec<Chart>,
    /// Charts side by side.
    pub columns: usize,
}

/// Why a picture could not be made.
#[derive(Debug, thiserror::Error)]
pub enum PlotError {
    /// The picture could not be drawn: an empty range, for instance.
    #[error("chart {title:?} could not be drawn: {problem}")]
    Drawing {
        /// Title of the chart, or of the sheet's first.
        title: String,
        /// What the drawing library said.
        problem: String,
    },
    /// A file could not be written.
    #[error("{}: {source}", path.display())]
    Writing {
        /// File.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
}

const WIDTH_PX: u32 = 720;
const HEIGHT_PX: u32 = 460;
/// Room for the numbers beside a vertical axis and its label, and for one letter of a name.
const NUMBERS_PX: u32 = 64;
const LETTER_PX: u32 = 7;
/// Ticks at most, where they are numbers.
const TICKS: usize = 10;
/// Room for a legend above the names of an axis, as a share of their rows.
const LEGEND_ROWS: f64 = 0.25;
/// Distinct also for colour-blind readers (Okabe and Ito), darkest first.
const COLOURS: [RGBColor; 9] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(90, 90, 90),
    RGBColor(0, 0, 0),
    RGBColor(122, 70, 20),
];
/// Share of a chart's width that its legend takes, and of its height for each entry.
const LEGEND: (f64, f64) = (0.36, 0.06);
/// Places between two points of a line that a legend should not cover.
const BETWEEN: u32 = 8;

impl Chart {
    /// A chart without points yet.
    #[must_use]
    pub fn new(title: impl Into<String>, x: Axis, y: Axis) -> Self {
        Self {
            title: title.into(),
            x,
            y,
            series: Vec::new(),
        }
    }

    /// With one more series.
    #[must_use]
    pub fn with(mut self, series: Series) -> Self {
        self.series.push(series);
        self
    }

    /// The chart as SVG.
    ///
    /// # Errors
    /// [`PlotError::Drawing`].
    pub fn svg(&self) -> Result<String, PlotError> {
        Sheet::of(self.clone()).svg()
    }

    /// Writes `STEM.svg` and `STEM.png`.
    ///
    /// # Errors
    /// [`PlotError`] when it can't be drawn or written.
    pub fn save(&self, stem: &Path) -> Result<(), PlotError> {
        Sheet::of(self.clone()).save(stem)
    }

    fn draw(&self, area: &DrawingArea<SVGBackend<'_>, Shift>) -> Result<(), PlotError> {
        let points = || self.series.iter().flat_map(|series| &series.points);
        let x = self.x.range(points().map(|point| point.0));
        let y = self.y.range(points().map(|point| point.1));
        let corner = self.emptiest_corner(&x, &y);
        let log = |axis: &Axis, range: Range<f64>| {
            let ticks = axis.log_ticks(&range);
            range.log_scale().with_key_points(ticks)
        };
        match (self.x.log, self.y.log) {
            (false, false) => self.draw_in(area, x, y, corner),
            (true, false) => self.draw_in(area, log(&self.x, x), y, corner),
            (false, true) => self.draw_in(area, x, log(&self.y, y), corner),
            (true, true) => self.draw_in(area, log(&self.x, x), log(&self.y, y), corner),
        }
    }

    /// Where a legend covers least of what is drawn.
    fn emptiest_corner(&self, x: &Range<f64>, y: &Range<f64>) -> SeriesLabelPosition {
        let high = LEGEND.1 * self.series.len() as f64;
        let drawn: Vec<(f64, f64)> = self
            .series
            .iter()
            .flat_map(|series| series.points.windows(2))
            .flat_map(|ends| {
                let place = |(u, v): (f64, f64)| (self.x.share(u, x), self.y.share(v, y));
                let (from, to) = (place(ends[0]), place(ends[1]));
                (0..=BETWEEN).map(move |k| {
                    let t = f64::from(k) / f64::from(BETWEEN);
                    (from.0 + t * (to.0 - from.0), from.1 + t * (to.1 - from.1))
                })
            })
            .collect();
        let covered = |right: bool, upper: bool| {
            let near = |share: f64, far: bool| if far { 1.0 - share } else { share };
            let under = |(u, v): &&(f64, f64)| {
                (0.0..LEGEND.0).contains(&near(*u, right)) && (0.0..high).contains(&near(*v, upper))
            };
            drawn.iter().filter(under).count()
        };
        [
            (covered(false, true), SeriesLabelPosition::UpperLeft),
            (covered(true, true), SeriesLabelPosition::UpperRight),
            (covered(true, false), SeriesLabelPosition::LowerRight),
            (covered(false, false), SeriesLabelPosition::LowerLeft),
        ]
        .into_iter()
        .min_by_key(|(covered, _)| *covered)
        .map_or(SeriesLabelPosition::UpperLeft, |(_, corner)| corner)
    }

    fn draw_in<X, Y>(
        &self,
        area: &DrawingArea<SVGBackend<'_>, Shift>,
        x: X,
        y: Y,
        corner: SeriesLabelPosition,
    ) -> Result<(), PlotError>
    where
        X: AsRangedCoord<Value = f64>,
        Y: AsRangedCoord<Value = f64>,
        X::CoordDescType: ValueFormatter<f64>,
        Y::CoordDescType: ValueFormatter<f64>,
    {
        let failed = |error: DrawingAreaErrorKind<_>| self.failed(&error);
        let mut chart = ChartBuilder::on(area)
            .caption(&self.title, ("sans-serif", 20))
            .margin(12)
            .x_label_area_size(44)
            .y_label_area_size(self.y.room_px())
            .build_cartesian_2d(x, y)
            .map_err(failed)?;
        chart
            .configure_mesh()
            .x_desc(&self.x.label)
            .y_desc(&self.y.label)
            .y_labels(self.y.most_ticks())
            .x_label_formatter(&|value| self.x.tick(*value))
            .y_label_formatter(&|value| self.y.tick(*value))
            .light_line_style(TRANSPARENT)
            .label_style(("sans-serif", 14))
            .draw()
            .map_err(failed)?;
        for (series, colour) in self.series.iter().zip(COLOURS.iter().cycle()) {
            self.draw_series(&mut chart, series, *colour)?;
        }
        if self.series.iter().any(|series| !series.label.is_empty()) {
            chart
                .configure_series_labels()
                .position(corner)
                .background_style(WHITE.mix(0.8))
                .border_style(BLACK.mix(0.3))
                .label_font(("sans-serif", 13))
                .draw()
                .map_err(failed)?;
        }
        Ok(())
    }

    fn draw_series<X, Y>(
        &self,
        chart: &mut ChartContext<'_, SVGBackend<'_>, Cartesian2d<X, Y>>,
        series: &Series,
        colour: RGBColor,
    ) -> Result<(), PlotError>
    where
        X: Ranged<ValueType = f64>,
        Y: Ranged<ValueType = f64>,
    {
        let failed = |error: DrawingAreaErrorKind<_>| self.failed(&error);
        let shown: Vec<(f64, f64)> = series
            .points
            .iter()
            .copied()
            .filter(|(x, y)| self.x.shows(*x) && self.y.shows(*y))
            .collect();
        let style = colour.stroke_width(2);
        let mut legend = None;
        if matches!(series.mark, Mark::Line | Mark::LineAndDots) {
            legend = Some(
                chart
                    .draw_series(LineSeries::new(shown.clone(), style))
                    .map_err(failed)?,
            );
        }
        if series.mark == Mark::Dashed {
            let dashes = DashedLineSeries::new(shown.clone(), 8, 5, style);
            legend = Some(chart.draw_series(dashes).map_err(failed)?);
        }
        if series.mark == Mark::Spans {
            let spans = shown
                .chunks_exact(2)
                .map(|ends| PathElement::new(ends.to_vec(), style.stroke_width(4)));
            legend = Some(chart.draw_series(spans).map_err(failed)?);
        }
        if matches!(series.mark, Mark::Dots | Mark::LineAndDots) {
            let dots = shown
                .iter()
                .map(|point| Circle::new(*point, 3, colour.filled()));
            legend = Some(chart.draw_series(dots).map_err(failed)?);
        }
        if let (Some(legend), false) = (legend, series.label.is_empty()) {
            // A dashed line is half a line here too.
            let reach = if series.mark == Mark::Dashed { 9 } else { 18 };
            legend
                .label(&series.label)
                .legend(move |(x, y)| PathElement::new(vec![(x, y), (x + reach, y)], style));
        }
        Ok(())
    }

    fn failed<E: std::error::Error + Send + Sync>(
        &self,
        error: &DrawingAreaErrorKind<E>,
    ) -> PlotError {
        PlotError::Drawing {
            title: self.title.clone(),
            problem: error.to_string(),
        }
    }
}

impl Sheet {
    /// A sheet of one chart.
    #[must_use]
    pub fn of(chart: Chart) -> Self {
        Self {
            charts: vec![chart],
            columns: 1,
        }
    }

    /// The sheet as SVG.
    ///
    /// # Errors
    /// [`PlotError::Drawing`].
    pub fn svg(&self) -> Result<String, PlotError> {
        let columns = self.columns.max(1);
        let rows = self.charts.len().div_ceil(columns).max(1);
        let size = (WIDTH_PX * columns as u32, HEIGHT_PX * rows as u32);
        let mut text = String::new();
        {
            let area = SVGBackend::with_string(&mut text, size).into_drawing_area();
            area.fill(&WHITE).map_err(|error| self.failed(&error))?;
            for (chart, part) in self.charts.iter().zip(area.split_evenly((rows, columns))) {
                chart.draw(&part)?;
            }
            area.present().map_err(|error| self.failed(&error))?;
        }
        Ok(text)
    }

    /// Writes `STEM.svg` and `STEM.png`.
    ///
    /// # Errors
    /// [`PlotError`] when it can't be drawn or written.
    pub fn save(&self, stem: &Path) -> Result<(), PlotError> {
        let svg = self.svg()?;
        let png = self.png(&svg)?;
        write(&stem.with_added_extension("svg"), svg.as_bytes())?;
        write(&stem.with_added_extension("png"), &png)
    }

    fn png(&self, svg: &str) -> Result<Vec<u8>, PlotError> {
        let refused = |problem: String| PlotError::Drawing {
            title: self.title(),
            problem,
        };
        let mut options = usvg::Options::default();
        let fonts = Arc::make_mut(&mut options.fontdb);
        fonts.load_font_data(epaint_default_fonts::UBUNTU_LIGHT.to_vec());
        let family = fonts
            .faces()
            .next()
            .and_then(|face| face.families.first())
            .map(|family| family.0.clone());
        fonts.set_sans_serif_family(family.unwrap_or_default());
        let tree = usvg::Tree::from_str(svg, &options).map_err(|e| refused(e.to_string()))?;
        let size = tree.size().to_int_size();
        let mut pixels = tiny_skia::Pixmap::new(size.width(), size.height())
            .ok_or_else(|| refused("it has no pixels".to_owned()))?;
        resvg::render(
            &tree,
            tiny_skia::Transform::identity(),
            &mut pixels.as_mut(),
        );
        pixels.encode_png().map_err(|e| refused(e.to_string()))
    }

    fn title(&self) -> String {
        self.charts
            .first()
            .map_or_else(String::new, |chart| chart.title.clone())
    }

    fn failed<E: std::error::Error + Send + Sync>(
        &self,
        error: &DrawingAreaErrorKind<E>,
    ) -> PlotError {
        PlotError::Drawing {
            title: self.title(),
            problem: error.to_string(),
        }
    }
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), PlotError> {
    std::fs::write(path, bytes).map_err(|source| PlotError::Writing {
        path: path.to_owned(),
        source,
    })
}

/// A tick's number without noise digits.
fn short(value: f64) -> String {
    let text = format!("{value:.3}");
    let trimmed = text.trim_end_matches('0').trim_end_matches('.');
    if trimmed == "-0" { "0" } else { trimmed }.to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart() -> Chart {
        Chart::new(
            "Error against range",
            Axis::log("range, m"),
            Axis::linear("error, m"),
        )
        .with(Series::new(
            "measured",
            Mark::LineAndDots,
            vec![(10.0, 1.0), (100.0, 4.0), (f64::NAN, 2.0), (-1.0, 0.0)],
        ))
        .with(Series::new(
            "bound",
            Mark::Dashed,
            vec![(10.0, 0.9), (100.0, 3.5)],
        ))
    }

    #[test]
    fn a_sheet_is_written_as_svg_and_png_with_its_text() {
        let folder = tempfile::tempdir().unwrap();
        let stem = folder.path().join("location.v1");
        let sheet = Sheet {
            charts: vec![chart(), chart(), chart()],
            columns: 2,
        };
        sheet.save(&stem).unwrap();
        let svg = std::fs::read_to_string(folder.path().join("location.v1.svg")).unwrap();
        assert!(svg.contains("Error against range") && svg.contains("measured"));
        let png = std::fs::read(folder.path().join("location.v1.png")).unwrap();
        assert!(png.starts_with(b"\x89PNG"));
    }

    #[test]
    fn text_reaches_the_picture() {
        let without = Chart {
            title: String::new(),
            ..chart()
        };
        let dark = |chart: &Chart| {
            let sheet = Sheet::of(chart.clone());
            let png = sheet.png(&sheet.svg().unwrap()).unwrap();
            let pixels = tiny_skia::Pixmap::decode_png(&png).unwrap();
            pixels.pixels().iter().filter(|p| p.red() < 100).count()
        };
        assert!(dark(&chart()) > dark(&without) + 100);
    }

    #[test]
    fn each_name_of_an_axis_stands_at_its_tick() {
        let names: Vec<String> = (0..16).map(|index| format!("name {index}.")).collect();
        let rows = (0..16).map(|index| (1.0, -f64::from(index))).collect();
        let chart = Chart::new("rows", Axis::linear("x"), Axis::named(names.clone()))
            .with(Series::new("dots", Mark::Dots, rows));
        let svg = chart.svg().unwrap();
        let heights: Vec<f64> = names.iter().map(|name| height_of(&svg, name)).collect();
        assert!(
            heights.windows(2).all(|pair| pair[0] < pair[1]),
            "{heights:?}"
        );
    }

    /// Where a text stands, pixels from the top.
    fn height_of(svg: &str, text: &str) -> f64 {
        let ends = svg.find(text).unwrap();
        let element = &svg[svg[..ends].rfind("<text").unwrap()..ends];
        let value = element.split(" y=\"").nth(1).unwrap();
        value.split('"').next().unwrap().parse().unwrap()
    }

    #[test]
    fn a_chart_without_points_is_an_empty_chart() {
        let empty = Chart::new("none", Axis::linear("x"), Axis::log("y"));
        assert!(empty.svg().unwrap().contains("none"));
    }
}
