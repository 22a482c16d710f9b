//! `emberfix calibrate stereo` as its users run it, held against OpenCV's Python: on a real rig's pictures,
//! on pictures with known truth that OpenCV printed, and before a camera that shows them one by one.

#![expect(clippy::unwrap_used, reason = "a test may stop at its first surprise")]

#[path = "support/board_camera.rs"]
mod board_camera;
#[path = "support/clients.rs"]
#[expect(
    dead_code,
    reason = "nothing is stopped here, nor says where it listens"
)]
mod clients;
#[path = "support/shared.rs"]
mod shared;
mod support;

use board_camera::show;
use bytes::Bytes;
use clients::{Clients, Running};
use emberfix_calib::solve::Dictionary;
use serde_json::Value;
use shared::shared_data;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::Command;
use support::{Said, Scratch, emberfix};

fn calibrate(arguments: &[&str]) -> Command {
    let mut command = emberfix();
    command.args(["calibrate", "stereo"]).args(arguments);
    command
}

fn numbers(value: &Value) -> Vec<f64> {
    let list = value.as_array().unwrap();
    list.iter().map(|number| number.as_f64().unwrap()).collect()
}

#[test]
fn on_the_same_corners_we_say_what_opencv_says() {
    let (Some(clients), Some(folder)) = (Clients::find(), shared_data("stereo/chess_a")) else {
        return;
    };
    let scratch = Scratch::new();
    let corners = scratch.path("corners.json");
    let solve = |more: &[&str]| -> Value {
        let mut command = calibrate(&[folder.to_str().unwrap(), "--board", "9x6"]);
        command.args(["--square-mm", "24.23", "--keep-all", "--json"]);
        command.arg("--corners").arg(&corners).args(more);
        Said::of(&command.output().unwrap()).json()
    };
    let full = solve(&[]);
    let alike = solve(&["--like-opencv"]);
    let theirs = clients.run("stereo_oracle.py", [&corners]).json();
    let (values, sigmas) = (numbers(&alike["values"]), numbers(&alike["sigmas"]));
    let full_values = numbers(&full["values"]);
    let (mut worst, mut worst_full) = (0.0_f64, 0.0_f64);
    for (at, other) in numbers(&theirs["values"]).into_iter().enumerate() {
        let name = &alike["parameters"][at];
        let off = (values[at] - other) / sigmas[at];
        let full_off = (full_values[at] - other) / sigmas[at];
        println!(
            "{name}: {off:+.3} sigma from OpenCV; with an uneven, moving board {full_off:+.3}"
        );
        assert!(off.abs() < 1.0, "{name}: {} and {other}", values[at]);
        worst = worst.max(off.abs());
        worst_full = worst_full.max(full_off.abs());
    }
    println!("worst {worst:.4} sigma; with an uneven, moving board {worst_full:.2}");
}

/// Pictures of a board with known truth.
fn pictures(clients: &Clients, scratch: &Scratch, kind: &str, pairs: usize) -> (PathBuf, Value) {
    let folder = scratch.path(kind);
    let arguments = [folder.to_str().unwrap(), kind, &pairs.to_string()].map(str::to_owned);
    let truth = clients.run("board_pairs.py", arguments).json();
    (folder, truth)
}

/// Every number of the rig within three of its own sigmas, and those small.
fn assert_true(found: &Value, truth: &Value) {
    let (values, sigmas) = (numbers(&found["values"]), numbers(&found["sigmas"]));
    let wanted = [
        (0, "left", 4),
        (9, "right", 4),
        (18, "rotation", 3),
        (21, "translation_m", 3),
    ];
    for (first, key, count) in wanted {
        for (at, true_value) in numbers(&truth[key]).into_iter().enumerate().take(count) {
            let (value, sigma) = (values[first + at], sigmas[first + at]);
            let name = &found["parameters"][first + at];
            println!("{name}: {value:.5} ± {sigma:.5}, truth {true_value:.5}");
            assert!((value - true_value).abs() < 3.0 * sigma, "{name}");
        }
    }
    assert!(sigmas[0] < 2.0, "focal length ± {} px", sigmas[0]);
    assert!(sigmas[21] < 5e-4, "translation ± {} m", sigmas[21]);
}

#[test]
fn a_charuco_board_that_hangs_out_of_the_pictures_calibrates_both_eyes() {
    let Some(clients) = Clients::find() else {
        return;
    };
    let scratch = Scratch::new();
    let (folder, truth) = pictures(&clients, &scratch, "charuco", 30);
    let board = [
        "--board",
        "charuco:9x6",
        "--square-mm",
        "28",
        "--marker-mm",
        "21",
    ];
    let corners = scratch.path("corners.json");
    let mut command = calibrate(&[folder.to_str().unwrap(), "--json"]);
    command.args(board).arg("--corners").arg(&corners);
    let found = Said::of(&command.output().unwrap()).json();
    assert_true(&found, &truth);

    let found: Value = serde_json::from_slice(&std::fs::read(&corners).unwrap()).unwrap();
    let views = found["views"].as_array().unwrap();
    let in_part = views
        .iter()
        .filter(|view| view["left"].as_array().unwrap().len() < 40)
        .count();
    println!("{} pairs, {in_part} seen in part", views.len());
    assert!(views.len() >= 25 && in_part >= 5);
}

#[test]
fn the_dictionaries_are_opencvs() {
    let Some(clients) = Clients::find() else {
        return;
    };
    let theirs = clients.run("marker_bits.py", [""; 0]).json();
    for (name, markers) in theirs.as_object().unwrap() {
        let dictionary = Dictionary::parse(name).unwrap();
        let side = dictionary.side_bits();
        for (id, rows) in markers.as_array().unwrap().iter().enumerate() {
            let bits = rows.as_str().unwrap().as_bytes();
            let ours = (0..side * side).map(|at| dictionary.is_white(id, at / side, at % side));
            assert!(
                ours.eq(bits.iter().map(|bit| Some(*bit == b'1'))),
                "{name} {id}"
            );
        }
    }
}

fn png(folder: &Path, name: &str) -> Bytes {
    Bytes::from(std::fs::read(folder.join(name)).unwrap())
}

#[test]
fn before_a_camera_it_says_what_is_missing_and_ends_when_there_is_enough() {
    let Some(clients) = Clients::find() else {
        return;
    };
    let scratch = Scratch::new();
    let (folder, truth) = pictures(&clients, &scratch, "chess", 40);
    let free = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = free.local_addr().unwrap().port();
    drop(free);
    let url = format!("tcp-listen:127.0.0.1:{port}");
    let mut command = calibrate(&[
        "--live",
        &url,
        "--board",
        "9x6",
        "--square-mm",
        "28",
        "--json",
    ]);
    command.args(["--live-limit-s", "300"]);
    command.arg("--keep").arg(scratch.path("kept"));
    let (mut running, _) = Running::start(command, "show the board");
    let pairs = (1..=40).map(|number| {
        let eye = |eye: &str| png(&folder, &format!("{eye}_{number:03}.png"));
        [eye("left"), eye("right")]
    });
    show(port, pairs.collect());
    let said = running.wait();
    let log = said.err.as_str();
    println!("{log}");
    let found = said.json();
    assert_true(&found, &truth);
    let first = log
        .lines()
        .find(|line| line.starts_with("pair 001 taken"))
        .unwrap();
    assert!(first.contains("still missing: left edge away"), "{first}");
    assert!(log.contains("hold the board still"), "{log}");
    assert!(log.contains("that is enough"), "{log}");
    let kept = std::fs::read_dir(scratch.path("kept")).unwrap().count();
    let used =
        found["views"].as_array().unwrap().len() + found["dropped"].as_array().unwrap().len();
    assert_eq!(kept, 2 * used);
}

#[test]
fn what_can_not_be_calibrated_is_refused_in_one_line() {
    let scratch = Scratch::new();
    let here = scratch.path("");
    let here = here.to_str().unwrap();
    let cases: [(&[&str], &str); 7] = [
        (
            &[here, "--board", "9x6", "--square-mm", "28"],
            "no pairs among 0 image files",
        ),
        (
            &[here, "--board", "9by6", "--square-mm", "28"],
            "such as 9x6",
        ),
        (
            &[here, "--board", "9x6", "--square-mm", "28000"],
            "given in mm",
        ),
        (
            &[here, "--board", "charuco:9x6", "--square-mm", "28"],
            "--marker-mm is needed",
        ),
        (
            &[
                here,
                "--board",
                "charuco:9x6",
                "--square-mm",
                "28",
                "--marker-mm",
                "28",
            ],
            "0.4 to 0.95 of a square",
        ),
        (
            &[
                "--live",
                "tcp:nowhere",
                "--board",
                "9x6",
                "--square-mm",
                "28",
            ],
            "camera url",
        ),
        (
            &[
                "--live",
                "folder:/nowhere",
                "--board",
                "9x6",
                "--square-mm",
                "28",
            ],
            "/nowhere",
        ),
    ];
    for (arguments, words) in cases {
        let said = Said::of(&calibrate(arguments).output().unwrap());
        println!("{}", said.err.trim());
        assert_eq!(said.code, 2, "{said:?}");
        assert!(said.err.contains(words), "{}", said.err);
        assert_eq!(said.err.trim().lines().count(), 1, "{}", said.err);
    }
}
