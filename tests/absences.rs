//! What is not there: the imports that `src/lib.rs` and `ARCHITECTURE.md` promise away.

#![expect(clippy::unwrap_used, reason = "a test may stop at its first surprise")]

use std::path::{Path, PathBuf};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn rust_files(folder: &str) -> Vec<(PathBuf, String)> {
    let mut found = Vec::new();
    let mut folders = vec![root().join(folder)];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|ending| ending == "rs") {
                let text = std::fs::read_to_string(&path).unwrap();
                found.push((path, text));
            }
        }
    }
    assert!(!found.is_empty(), "{folder} holds no Rust files");
    found
}

/// Lines of code that hold a word, comments aside.
fn lines_with<'a>(text: &'a str, word: &'a str) -> impl Iterator<Item = &'a str> {
    text.lines()
        .filter(move |line| !line.trim_start().starts_with("//") && line.contains(word))
}

fn assert_absent(folder: &str, words: &[&str]) {
    for (path, text) in rust_files(folder) {
        if path.file_name().is_some_and(|name| name == "tests.rs") {
            continue;
        }
        for word in words {
            let found: Vec<_> = lines_with(&text, word).collect();
            assert!(
                found.is_empty(),
                "{} must not use {word}: {found:?}",
                path.display()
            );
        }
    }
}

#[test]
fn the_core_reads_no_clock_and_does_no_io() {
    let io = [
        "std::fs",
        "std::net",
        "std::time",
        "tokio",
        "std::thread",
        "rusqlite",
        "opencv::videoio",
    ];
    for room in [
        "src/locate",
        "src/track",
        "src/alarm",
        "src/assess",
        "src/pipeline",
        "frames/src",
    ] {
        assert_absent(room, &io);
    }
}

#[test]
fn only_detect_uses_onnx_runtime_and_only_range_matches_stereo() {
    for (path, text) in rust_files("src") {
        let in_room = |room: &str| path.starts_with(root().join("src").join(room));
        if !in_room("detect") {
            assert_eq!(lines_with(&text, " ort::").count(), 0, "{}", path.display());
        }
        // What measures ranging runs the papers' matching beside it.
        if !in_room("range") && !in_room("eval/range") {
            assert_eq!(
                lines_with(&text, "StereoSGBM").count(),
                0,
                "{}",
                path.display()
            );
        }
    }
}

#[test]
fn only_frames_asserts_frame_relations() {
    for folder in ["src", "calib/src", "mav/src", "sim/src"] {
        assert_absent(folder, &["unsafe "]);
    }
}

#[test]
fn only_eval_knows_the_simulator_and_mav_does_not_know_fire() {
    for (path, text) in rust_files("src") {
        let measures = ["src/eval", "src/cli/eval"];
        if !measures
            .iter()
            .any(|room| path.starts_with(root().join(room)))
        {
            assert_eq!(
                lines_with(&text, "emberfix_sim").count(),
                0,
                "{}",
                path.display()
            );
        }
        if !path.starts_with(root().join("src/cli")) && !path.starts_with(root().join("src/eval")) {
            assert_eq!(
                lines_with(&text, "crate::eval").count(),
                0,
                "{}",
                path.display()
            );
        }
    }
    assert_absent("mav/src", &["fire", "Fire"]);
    assert_absent("sim/src", &["emberfix::"]);
}

#[test]
fn the_domain_imports_no_adapter() {
    let adapters = [
        "crate::deliver",
        "crate::record",
        "crate::ingest",
        "crate::ground",
        "crate::service",
    ];
    for room in [
        "src/locate",
        "src/track",
        "src/alarm",
        "src/assess",
        "src/pose",
        "src/detect",
        "src/range",
    ] {
        assert_absent(room, &adapters);
    }
}
