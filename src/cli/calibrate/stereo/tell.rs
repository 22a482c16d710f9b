//! What came of it, for people and as JSON.

use super::StereoArguments;
use super::look::Looked;
use crate::cli::Failure;
use comfy_table::Table;
use emberfix_calib::Severity;
use emberfix_calib::solve::{
    Board, Calibration, Corner, ViewResiduals, epipolar_rms_px, parameter_names,
};

/// What forbids flying with it.
pub fn refusals(calibration: &Calibration) -> Vec<String> {
    let refused = calibration.findings.iter();
    refused
        .filter(|finding| finding.severity == Severity::Refusal)
        .map(ToString::to_string)
        .collect()
}

/// Prints it.
pub fn tell(
    arguments: &StereoArguments,
    looked: &Looked,
    calibration: &Calibration,
) -> Result<(), Failure> {
    if arguments.json {
        println!("{:#}", json(looked, calibration)?);
        return Ok(());
    }
    for (name, why) in &looked.unusable {
        println!("not used: {name}: {why}");
    }
    for dropped in &calibration.dropped {
        println!(
            "dropped: {}: error {:.3} px, the others allow {:.3} px",
            dropped.name, dropped.rms_px, dropped.limit_px
        );
    }
    println!("{}", summary(calibration)?);
    println!("{}", range_table(calibration));
    for finding in &calibration.findings {
        let word = match finding.severity {
            Severity::Refusal => "REFUSED",
            Severity::Doubt => "doubt",
        };
        println!("{word}: {finding}");
    }
    Ok(())
}

fn table() -> Table {
    let mut table = Table::new();
    table.load_style(comfy_table::presets::UTF8_HORIZONTAL_ONLY);
    table
}

fn summary(calibration: &Calibration) -> Result<Table, Failure> {
    let solution = &calibration.solution;
    let (values, sigmas) = (solution.values(), solution.sigmas());
    let with = |index: usize| format!("{:.2} ± {:.2} px", values[index], sigmas[index]);
    let turn = |axis: usize| {
        format!(
            "{:.3} ± {:.3}",
            values[18 + axis].to_degrees(),
            sigmas[18 + axis].to_degrees()
        )
    };
    let [left, right] = calibration.coverage.map(|share| 100.0 * share);
    let mut table = table();
    table.set_header(["", "one sigma"]);
    table.add_row(["pairs", &calibration.views.len().to_string()]);
    let errors = format!(
        "{:.3} px fitted, {:.3} px held out",
        solution.rms_px(),
        calibration.held_out.rms_px
    );
    table.add_row(["reprojection error", &errors]);
    let rows = format!(
        "{:.3} px",
        epipolar_rms_px(calibration).map_err(Failure::failed)?
    );
    table.add_row(["row difference, rectified", &rows]);
    table.add_row(["focal length, left", &with(0)]);
    table.add_row(["focal length, right", &with(9)]);
    let baseline = format!(
        "{:.2} ± {:.2} mm",
        1e3 * solution.baseline_m(),
        1e3 * solution.baseline_sigma_m()
    );
    table.add_row(["baseline", &baseline]);
    let rotation = format!("{}, {}, {} degrees", turn(0), turn(1), turn(2));
    table.add_row(["right from left, rotation", &rotation]);
    table.add_row(["corners, left and right", &corner_noise(calibration)]);
    if solution.model.uneven_board {
        table.add_row(["board, out of its plane", &unevenness(calibration)]);
    }
    if solution.model.moving_board {
        table.add_row(["board, from eye to eye", &steps(calibration)]);
    }
    table.add_row(["coverage", &format!("{left:.0} % left, {right:.0} % right")]);
    Ok(table)
}

fn corner_noise(calibration: &Calibration) -> String {
    let [left, right] = calibration.solution.corner_sigma_px;
    format!("± {left:.3} px, ± {right:.3} px per axis")
}

/// How far the print lies from the plane through it.
fn unevenness(calibration: &Calibration) -> String {
    let heights = calibration.solution.uneven_m.iter().map(|off| 1e3 * off.z);
    let (low, high) = heights.fold((f64::MAX, f64::MIN), |(low, high), height| {
        (low.min(height), high.max(height))
    });
    format!("{low:.2} to {high:.2} mm")
}

fn steps(calibration: &Calibration) -> String {
    let (turn_rad, move_m) = calibration.solution.step_sigma;
    format!(
        "± {:.2} mm, ± {:.2} degrees per axis",
        1e3 * move_m,
        turn_rad.to_degrees()
    )
}

fn range_table(calibration: &Calibration) -> Table {
    let mut table = table();
    table.set_header(["depth, m", "± range from calibration, m", "%"]);
    for error in &calibration.range_errors {
        table.add_row([
            format!("{}", error.depth_m),
            format!("{:.3}", error.sigma_m),
            format!("{:.2}", 100.0 * error.share()),
        ]);
    }
    table
}

fn json(looked: &Looked, calibration: &Calibration) -> Result<serde_json::Value, Failure> {
    let solution = &calibration.solution;
    let covariance: Vec<Vec<f64>> = solution
        .covariance
        .row_iter()
        .map(|row| row.iter().copied().collect())
        .collect();
    let views: Vec<_> = solution
        .residuals
        .iter()
        .map(|view| serde_json::json!({"name": view.name, "rms_px": ViewResiduals::rms_px(view)}))
        .collect();
    let figure = |name: &str, value: f64, unit: &'static str| {
        emberfix_report::Figure::told(name, Some(value), unit, calibration.views.len())
    };
    Ok(serde_json::json!({
        "figures": [
            figure("calibrate.rms_px", solution.rms_px(), "px"),
            figure("calibrate.held_out_rms_px", calibration.held_out.rms_px, "px"),
            figure("calibrate.epipolar_rms_px", epipolar_rms_px(calibration).map_err(Failure::failed)?, "px"),
            figure("calibrate.baseline", solution.baseline_m(), "m"),
            figure("calibrate.baseline_sigma", solution.baseline_sigma_m(), "m"),
            figure("calibrate.disparity_sigma", calibration.disparity_sigma_px, "px"),
        ],
        "parameters": parameter_names(),
        "values": solution.values().as_slice(),
        "sigmas": solution.sigmas().as_slice(),
        "covariance": covariance,
        "image_size_px": [looked.size.0, looked.size.1],
        "corner_sigma_px": solution.corner_sigma_px,
        "widened_by": solution.widened_by,
        "board_off_m": solution.uneven_m.iter().map(|off| off.as_slice()).collect::<Vec<_>>(),
        "step_sigma": {"turn_rad": solution.step_sigma.0, "move_m": solution.step_sigma.1},
        "steps_m": solution.steps.iter().map(|step| step.move_m.as_slice()).collect::<Vec<_>>(),
        "coverage": calibration.coverage,
        "range": calibration.range_errors.iter()
            .map(|error| serde_json::json!({"depth_m": error.depth_m, "sigma_m": error.sigma_m}))
            .collect::<Vec<_>>(),
        "views": views,
        "dropped": calibration.dropped.iter()
            .map(|view| serde_json::json!({"name": view.name, "rms_px": view.rms_px, "limit_px": view.limit_px}))
            .collect::<Vec<_>>(),
        "unusable": looked.unusable,
        "refused": calibration.is_refused(),
        "findings": calibration.findings.iter().map(ToString::to_string).collect::<Vec<_>>(),
    }))
}

/// Every corner: its number, its place on the board, its pixel.
pub fn corners(board: &Board, looked: &Looked) -> serde_json::Value {
    let eye = |corners: &[Corner]| -> Vec<_> {
        let corner = |corner: &Corner| {
            let on_board = board.point_m(corner.id);
            serde_json::json!({
                "id": corner.id, "board_m": [on_board.x, on_board.y],
                "pixel": [corner.pixel.u, corner.pixel.v],
            })
        };
        corners.iter().map(corner).collect()
    };
    let views: Vec<_> = looked
        .views
        .iter()
        .map(|view| {
            serde_json::json!({
                "name": view.name, "left": eye(&view.left), "right": eye(&view.right),
            })
        })
        .collect();
    serde_json::json!({
        "board": board.words(), "image_size_px": [looked.size.0, looked.size.1], "views": views,
    })
}
