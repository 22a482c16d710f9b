//! A calibration as one HTML page that needs nothing else: what was covered, what is left, what it
//! means for ranges, and the rectified pair to look at.

use crate::solve::{
    COVERAGE_CELLS, Calibration, Residual, SolveError, ViewResiduals, cell, epipolar_rms_px,
    parameter_names, rectification,
};
use crate::{Eye, Rectification, Severity};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use opencv::core::{Mat, Scalar, Vector};
use opencv::{imgcodecs, imgproc};
use std::fmt::Write as _;

/// What the page shows beside the calibration.
#[derive(Debug)]
pub struct PageInput<'a> {
    /// Name of the rig.
    pub name: &'a str,
    /// When, for people.
    pub at: &'a str,
    /// Board and squares, for people.
    pub board: &'a str,
    /// The calibration.
    pub calibration: &'a Calibration,
    /// One pair of grey images to show rectified: name, left, right.
    pub pair: Option<(&'a str, &'a Mat, &'a Mat)>,
}

const STYLE: &str = "
:root{color-scheme:light dark;--ink:#1c2430;--paper:#fff;--soft:#66707f;--line:#d8dde5;--good:#0a7a4b;
--bad:#b3261e;--doubt:#9a6200;--blue:#0072b2;--red:#d55e00}
@media(prefers-color-scheme:dark){:root{--ink:#e6eaf0;--paper:#14181f;--soft:#98a3b3;--line:#323a46;
--good:#4cc38a;--bad:#ff8a80;--doubt:#f2b84b;--blue:#56b4e9;--red:#e69f00}}
body{font:15px/1.5 system-ui,sans-serif;color:var(--ink);background:var(--paper);max-width:1080px;
margin:2rem auto;padding:0 1rem}
h1{font-size:1.5rem;margin:0}h2{font-size:1.1rem;margin:2rem 0 .4rem}p{margin:.3rem 0;color:var(--soft)}
table{border-collapse:collapse;font-variant-numeric:tabular-nums}td,th{padding:.2rem .8rem .2rem 0;
text-align:right;border-bottom:1px solid var(--line)}td:first-child,th:first-child{text-align:left}
.two{display:grid;grid-template-columns:1fr 1fr;gap:1rem}.two figure,figure{margin:0}
figcaption{color:var(--soft);font-size:.9rem}svg{width:100%;height:auto;display:block}
.cards{display:flex;flex-wrap:wrap;gap:.8rem;margin:1rem 0}.card{border:1px solid var(--line);
border-radius:8px;padding:.5rem .9rem}.card b{display:block;font-size:1.25rem}
.card span{color:var(--soft);font-size:.85rem}.refusal{color:var(--bad)}.doubt{color:var(--doubt)}
.good{color:var(--good)}li{margin:.2rem 0}details{margin-top:1rem}";

/// The page.
///
/// # Errors
/// [`SolveError::OpenCv`] when the pair can't be rectified or its picture not encoded.
pub fn page(input: &PageInput<'_>) -> Result<String, SolveError> {
    let calibration = input.calibration;
    let mut html = format!(
        "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><title>Calibration of {0}</title>\
         <meta name=\"viewport\" content=\"width=device-width\"><style>{STYLE}</style>\
         <h1>Calibration of {0}</h1><p>{1} · board {2} · {3} pairs</p>",
        escaped(input.name),
        escaped(input.at),
        escaped(input.board),
        calibration.views.len()
    );
    html += &verdict(calibration);
    html += &cards(calibration)?;
    html += &range_table(calibration);
    html += &coverage_and_residuals(calibration);
    html += &board(calibration);
    html += &per_view(calibration);
    if let Some((name, left, right)) = input.pair {
        html += &rectified_pair(calibration, name, left, right)?;
    }
    html += &parameters(calibration);
    Ok(html)
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

fn verdict(calibration: &Calibration) -> String {
    if calibration.findings.is_empty() {
        return "<p class=\"good\"><b>Good to fly:</b> nothing is implausible.</p>".to_owned();
    }
    let mut html = String::from(if calibration.is_refused() {
        "<p class=\"refusal\"><b>Refused.</b> Don't fly with it.</p><ul>"
    } else {
        "<p class=\"doubt\"><b>Usable, with doubts.</b></p><ul>"
    });
    for finding in &calibration.findings {
        let class = match finding.severity {
            Severity::Refusal => "refusal",
            Severity::Doubt => "doubt",
        };
        let _ = write!(
            html,
            "<li class=\"{class}\">{}</li>",
            escaped(&finding.sentence)
        );
    }
    html + "</ul>"
}

fn cards(calibration: &Calibration) -> Result<String, SolveError> {
    let solution = &calibration.solution;
    let turn_deg = rectification(solution)?.turn_rad(Eye::Left).to_degrees();
    let cards = [
        (format!("{:.3} px", solution.rms_px()), "reprojection error"),
        (
            format!("{:.3} px", calibration.held_out.rms_px),
            "on held-out pairs",
        ),
        (
            format!("{:.3} px", epipolar_rms_px(calibration)?),
            "row difference, rectified",
        ),
        (
            format!(
                "{:.2} ± {:.2} mm",
                1e3 * solution.baseline_m(),
                1e3 * solution.baseline_sigma_m()
            ),
            "baseline, one sigma",
        ),
        (
            format!(
                "{:.1} / {:.1} px",
                solution.left.focal_px.0, solution.right.focal_px.0
            ),
            "focal length, left / right",
        ),
        (format!("{turn_deg:.2}°"), "rectifying rotation"),
    ];
    let mut html = String::from("<div class=\"cards\">");
    for (value, label) in cards {
        let _ = write!(
            html,
            "<div class=\"card\"><b>{value}</b><span>{label}</span></div>"
        );
    }
    Ok(html + "</div>")
}

fn range_table(calibration: &Calibration) -> String {
    let mut html = String::from(
        "<h2>What it means for range</h2><p>One sigma that comes from the calibration alone; it is the \
         same in every frame of a flight and does not average out.</p><table><tr><th>depth</th>\
         <th>± range</th><th>share</th></tr>",
    );
    for error in &calibration.range_errors {
        let _ = write!(
            html,
            "<tr><td>{} m</td><td>{:.2} m</td><td>{:.2} %</td></tr>",
            error.depth_m,
            error.sigma_m,
            100.0 * error.share()
        );
    }
    let _ = write!(
        html,
        "</table><p>As an offset of disparity: ± {:.3} px.</p>",
        calibration.disparity_sigma_px
    );
    html
}

fn coverage_and_residuals(calibration: &Calibration) -> String {
    let views = &calibration.solution.residuals;
    let left: Vec<&Residual> = views.iter().flat_map(|view| &view.left).collect();
    let right: Vec<&Residual> = views.iter().flat_map(|view| &view.right).collect();
    let size = calibration.solution.left.image_size_px;
    let [left_share, right_share] = calibration.coverage.map(|share| 100.0 * share);
    format!(
        "<h2>Where corners were seen</h2><p>Dark cells hold many corners, crossed ones none: there the \
         lens is guessed.</p><div class=\"two\"><figure>{}<figcaption>left eye, {left_share:.0} % of \
         cells</figcaption></figure><figure>{}<figcaption>right eye, {right_share:.0} % of cells\
         </figcaption></figure></div><h2>What is left of every corner</h2><p>Found minus projected, \
         drawn {ARROW_SCALE:.0} times as long. Arrows that all point one way in one place mean that the \
         lens is not of this model.</p><div class=\"two\"><figure>{}<figcaption>left eye</figcaption>\
         </figure><figure>{}<figcaption>right eye</figcaption></figure></div>",
        coverage_svg(&left, size),
        coverage_svg(&right, size),
        arrows_svg(&left, size),
        arrows_svg(&right, size)
    )
}

/// What the pictures tell of the print and of the hands that held it.
fn board(calibration: &Calibration) -> String {
    let solution = &calibration.solution;
    if !solution.model.uneven_board {
        return String::new();
    }
    let heights = solution.uneven_m.iter().map(|off| 1e3 * off.z);
    let (low, high) = heights.fold((f64::MAX, f64::MIN), |(low, high), height| {
        (low.min(height), high.max(height))
    });
    let (turn_rad, move_m) = solution.step_sigma;
    format!(
        "<h2>What the pictures tell of the board</h2><p>Its corners lie {low:.2} to {high:.2} mm off its \
         plane: paper is never flat, and that is solved for. Between the eyes' exposures it moved by \
         ± {:.2} mm and turned by ± {:.2}° per axis as a rule: nothing, where both eyes are triggered at \
         once.</p>",
        1e3 * move_m,
        turn_rad.to_degrees()
    )
}

fn frame_svg((width, height): (u32, u32), body: &str) -> String {
    format!(
        "<svg viewBox=\"0 0 {width} {height}\" role=\"img\">{body}<rect width=\"{width}\" \
         height=\"{height}\" fill=\"none\" stroke=\"var(--line)\" stroke-width=\"2\"/></svg>"
    )
}

fn coverage_svg(corners: &[&Residual], size: (u32, u32)) -> String {
    let (columns, rows) = COVERAGE_CELLS;
    let mut counts = vec![0_usize; columns * rows];
    for corner in corners {
        if let Some(cell) = cell(corner.at, size) {
            counts[cell] += 1;
        }
    }
    let most = counts.iter().copied().max().unwrap_or(1).max(1) as f64;
    let (w, h) = (
        f64::from(size.0) / columns as f64,
        f64::from(size.1) / rows as f64,
    );
    let mut body = String::new();
    for (index, count) in counts.iter().enumerate() {
        let (x, y) = ((index % columns) as f64 * w, (index / columns) as f64 * h);
        if *count == 0 {
            let _ = write!(
                body,
                "<path d=\"M{x:.0} {y:.0}l{w:.0} {h:.0}m0 -{h:.0}l-{w:.0} {h:.0}\" \
                 stroke=\"var(--red)\" stroke-width=\"1.5\" opacity=\".5\"/>"
            );
        } else {
            let shade = 0.1 + 0.55 * (*count as f64 / most).sqrt();
            let _ = write!(
                body,
                "<rect x=\"{x:.0}\" y=\"{y:.0}\" width=\"{w:.0}\" height=\"{h:.0}\" \
                 fill=\"var(--blue)\" opacity=\"{shade:.2}\"/>"
            );
        }
    }
    for corner in corners {
        let _ = write!(
            body,
            "<circle cx=\"{:.0}\" cy=\"{:.0}\" r=\"{:.1}\" fill=\"var(--ink)\"/>",
            corner.at.u,
            corner.at.v,
            f64::from(size.0) / 500.0
        );
    }
    frame_svg(size, &body)
}

const ARROW_SCALE: f64 = 60.0;

fn arrows_svg(corners: &[&Residual], size: (u32, u32)) -> String {
    let mut path = String::new();
    for corner in corners {
        let (du, dv) = corner.off_px;
        let _ = write!(
            path,
            "M{:.0} {:.0}l{:.0} {:.0}",
            corner.at.u,
            corner.at.v,
            ARROW_SCALE * du,
            ARROW_SCALE * dv
        );
    }
    let width = f64::from(size.0) / 640.0;
    let body = format!(
        "<path d=\"{path}\" stroke=\"var(--blue)\" stroke-width=\"{width:.1}\" fill=\"none\"/>"
    );
    frame_svg(size, &body)
}

fn per_view(calibration: &Calibration) -> String {
    let mut bars: Vec<(&str, f64, bool)> = calibration
        .solution
        .residuals
        .iter()
        .map(|view| (view.name.as_str(), ViewResiduals::rms_px(view), true))
        .collect();
    bars.extend(
        calibration
            .dropped
            .iter()
            .map(|view| (view.name.as_str(), view.rms_px, false)),
    );
    let most = bars.iter().map(|bar| bar.1).fold(1e-9, f64::max);
    let (row, left, width) = (16.0, 220.0, 1000.0);
    let mut body = String::new();
    for (index, (name, rms_px, used)) in bars.iter().enumerate() {
        let y = index as f64 * row;
        let (colour, note) = if *used {
            ("--blue", "")
        } else {
            ("--red", ", dropped")
        };
        let _ = write!(
            body,
            "<text x=\"{:.0}\" y=\"{:.1}\" text-anchor=\"end\">{}</text><rect x=\"{left}\" y=\"{:.1}\" \
             width=\"{:.1}\" height=\"11\" fill=\"var({colour})\"/><text x=\"{:.1}\" y=\"{:.1}\">\
             {rms_px:.3} px{note}</text>",
            left - 8.0,
            y + 11.0,
            escaped(name),
            y + 2.0,
            rms_px / most * 600.0,
            left + rms_px / most * 600.0 + 8.0,
            y + 11.0
        );
    }
    format!(
        "<h2>Error of every pair</h2><svg viewBox=\"0 0 {width} {:.0}\" font-size=\"12\" \
         fill=\"var(--ink)\" role=\"img\">{body}</svg>",
        bars.len() as f64 * row
    )
}

fn rectified_pair(
    calibration: &Calibration,
    name: &str,
    left: &Mat,
    right: &Mat,
) -> Result<String, SolveError> {
    let rectification = rectification(&calibration.solution)?;
    let left = rectified_jpeg(&rectification, Eye::Left, left)?;
    let right = rectified_jpeg(&rectification, Eye::Right, right)?;
    let (width, height) = calibration.solution.left.image_size_px;
    let mut lines = String::new();
    for step in 1..16 {
        let y = height * step / 16;
        let _ = write!(lines, "M0 {y}h{}", 2 * width);
    }
    Ok(format!(
        "<h2>The rectified pair</h2><p>{}: every thing must lie on the same line in both eyes, and \
         further left in the right one.</p><svg viewBox=\"0 0 {2} {height}\" role=\"img\">\
         <image href=\"data:image/jpeg;base64,{left}\" width=\"{width}\" height=\"{height}\"/>\
         <image href=\"data:image/jpeg;base64,{right}\" x=\"{width}\" width=\"{width}\" \
         height=\"{height}\"/><path d=\"{lines}\" stroke=\"#ffb000\" stroke-width=\"{1:.1}\" \
         opacity=\".8\"/></svg>",
        escaped(name),
        f64::from(width) / 640.0,
        2 * width
    ))
}

fn rectified_jpeg(
    rectification: &Rectification,
    eye: Eye,
    image: &Mat,
) -> Result<String, SolveError> {
    let (columns, rows) = rectification.maps(eye)?;
    let mut rectified = Mat::default();
    imgproc::remap(
        image,
        &mut rectified,
        &columns,
        &rows,
        imgproc::INTER_LINEAR,
        opencv::core::BORDER_CONSTANT,
        Scalar::default(),
    )?;
    let mut bytes = Vector::<u8>::new();
    let quality = Vector::from_slice(&[imgcodecs::IMWRITE_JPEG_QUALITY, 80]);
    imgcodecs::imencode(".jpg", &rectified, &mut bytes, &quality)?;
    Ok(STANDARD.encode(bytes.as_slice()))
}

fn parameters(calibration: &Calibration) -> String {
    let solution = &calibration.solution;
    let values = solution.values();
    let sigmas = solution.sigmas();
    let mut html = String::from(
        "<details><summary>Every parameter with its sigma</summary><table><tr><th>parameter</th>\
         <th>value</th><th>± one sigma</th></tr>",
    );
    for (index, name) in parameter_names().iter().enumerate() {
        let _ = write!(
            html,
            "<tr><td>{name}</td><td>{:.6}</td><td>{:.6}</td></tr>",
            values[index], sigmas[index]
        );
    }
    html + "</table></details></html>"
}
