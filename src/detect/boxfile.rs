//! A detector that reads given boxes from a file: for recordings whose truth is known.
//!
//! One box per line, as JSON (`{"sequence": 3, "x": .., "y": .., "width": .., "height": .., "class":
//! "fire", "score": 0.9, "label": "pole"}`) or as CSV in the same order, with or without a header.
//! Pixels of the raw left image; `score` and `label` may be left out. Empty lines and lines that
//! begin with `#` are skipped; anything else that can't be read refuses the file.

use super::{BoxPx, DetectError, Detection, DetectionClass, Detector, LeftImage};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// One given box.
#[derive(Debug, Clone, PartialEq)]
pub struct GivenBox {
    /// As a detector reports it.
    pub detection: Detection,
    /// Whose box it is, if the file says.
    pub label: Option<String>,
}

/// Why a box file was refused.
#[derive(Debug, thiserror::Error)]
pub enum BoxFileError {
    /// The file can't be read.
    #[error("boxes {path}: {source}", path = path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A line that is no box.
    #[error("boxes {path}, line {line}: {problem}", path = path.display())]
    Line {
        /// The file.
        path: PathBuf,
        /// Line number, from 1.
        line: usize,
        /// What is wrong with it.
        problem: String,
    },
}

/// Reports the boxes that a file gives for each pair's sequence number.
#[derive(Debug, Clone)]
pub struct BoxFileDetector {
    boxes: BTreeMap<u64, Vec<GivenBox>>,
}

impl BoxFileDetector {
    /// Reads a box file.
    ///
    /// # Errors
    /// [`BoxFileError`] that names the file and the line.
    pub fn load(path: &Path) -> Result<Self, BoxFileError> {
        let text = std::fs::read_to_string(path).map_err(|source| BoxFileError::Read {
            path: path.to_owned(),
            source,
        })?;
        let boxes = parse(&text).map_err(|(line, problem)| BoxFileError::Line {
            path: path.to_owned(),
            line,
            problem,
        })?;
        Ok(Self { boxes })
    }

    /// The boxes of one pair, with their labels, best first.
    #[must_use]
    pub fn boxes(&self, sequence: u64) -> &[GivenBox] {
        self.boxes.get(&sequence).map_or(&[], Vec::as_slice)
    }
}

impl Detector for BoxFileDetector {
    fn detect(&mut self, image: &LeftImage) -> Result<Vec<Detection>, DetectError> {
        Ok(self
            .boxes(image.sequence)
            .iter()
            .map(|given| given.detection.clone())
            .collect())
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawBox {
    sequence: u64,
    x: f64,
    y: f64,
    width: f64,
    height: f64,
    class: DetectionClass,
    #[serde(default = "certain")]
    score: f64,
    label: Option<String>,
}

fn certain() -> f64 {
    1.0
}

fn parse(text: &str) -> Result<BTreeMap<u64, Vec<GivenBox>>, (usize, String)> {
    let mut boxes: BTreeMap<u64, Vec<GivenBox>> = BTreeMap::new();
    for (number, line) in (1..).zip(text.lines()) {
        let line = line.trim();
        if line.is_empty()
            || line.starts_with('#')
            || (number == 1 && line.starts_with("sequence,"))
        {
            continue;
        }
        let raw = read_line(line)
            .and_then(check)
            .map_err(|problem| (number, problem))?;
        let box_px = BoxPx {
            x: raw.x,
            y: raw.y,
            width: raw.width,
            height: raw.height,
        };
        let detection = Detection {
            class: raw.class,
            score: raw.score,
            box_px,
            mask: None,
            second_look: None,
        };
        boxes.entry(raw.sequence).or_default().push(GivenBox {
            detection,
            label: raw.label,
        });
    }
    for list in boxes.values_mut() {
        list.sort_by(|a, b| b.detection.score.total_cmp(&a.detection.score));
    }
    Ok(boxes)
}

fn read_line(line: &str) -> Result<RawBox, String> {
    if line.starts_with('{') {
        return serde_json::from_str(line).map_err(|error| error.to_string());
    }
    let fields: Vec<&str> = line.split(',').map(str::trim).collect();
    let (&[sequence, x, y, width, height, class], rest) =
        fields.split_first_chunk().ok_or_else(|| {
            format!(
                "{} fields, needed are sequence,x,y,width,height,class[,score[,label]]",
                fields.len()
            )
        })?;
    let number = |name: &str, text: &str| {
        text.parse::<f64>()
            .map_err(|_| format!("{name} is {text:?}, expected a number"))
    };
    let (score, label) = match rest {
        [] => (1.0, None),
        [score] => (number("score", score)?, None),
        [score, label] => (
            number("score", score)?,
            (!label.is_empty()).then(|| (*label).to_owned()),
        ),
        more => return Err(format!("{} fields too many", more.len() - 2)),
    };
    Ok(RawBox {
        sequence: sequence
            .parse()
            .map_err(|_| format!("sequence is {sequence:?}, expected a whole number from 0"))?,
        x: number("x", x)?,
        y: number("y", y)?,
        width: number("width", width)?,
        height: number("height", height)?,
        class: serde_json::from_value(class.into())
            .map_err(|_| format!("class is {class:?}, known are fire, smoke, non_fire"))?,
        score,
        label,
    })
}

fn check(raw: RawBox) -> Result<RawBox, String> {
    let wrong = |key: &str, value: f64, allowed: &str| {
        Err(format!("{key} is {value}, allowed is {allowed}"))
    };
    if !raw.x.is_finite() || !raw.y.is_finite() {
        return wrong(
            "x, y",
            if raw.x.is_finite() { raw.y } else { raw.x },
            "a finite number",
        );
    }
    for (key, length) in [("width", raw.width), ("height", raw.height)] {
        if !(length > 0.0 && length.is_finite()) {
            return wrong(key, length, "above 0");
        }
    }
    if !(0.0..=1.0).contains(&raw.score) {
        return wrong("score", raw.score, "0 to 1");
    }
    Ok(raw)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn json_lines_and_csv_mean_the_same() {
        let json = r#"{"sequence":3,"x":10.5,"y":20,"width":30,"height":40,"class":"fire","score":0.5,"label":"pot"}
{"sequence":3,"x":1,"y":2,"width":3,"height":4,"class":"non_fire"}"#;
        let csv = "sequence,x,y,width,height,class,score,label\n\n# by hand\n\
                   3, 10.5, 20, 30, 40, fire, 0.5, pot\n3,1,2,3,4,non_fire\n";
        assert_eq!(parse(json).unwrap(), parse(csv).unwrap());
        let boxes = parse(csv).unwrap();
        // Best first, whatever the order in the file.
        assert_eq!(boxes[&3][0].detection.class, DetectionClass::NonFire);
        assert_eq!(boxes[&3][1].label.as_deref(), Some("pot"));
    }

    #[test]
    fn a_malformed_line_is_refused_with_its_number() {
        let good = "0,1,2,3,4,fire";
        for bad in [
            "0,1,2,3,4",
            "0,1,2,3,4,flood",
            "-1,1,2,3,4,fire",
            "0,1,2,0,4,fire",
            "0,1,2,3,-4,fire",
            "0,NaN,2,3,4,fire",
            "0,1,2,inf,4,fire",
            "0,1,2,3,4,fire,1.5",
            "0,1,2,3,4,fire,0.5,pot,more",
            "{\"sequence\":0,\"x\":1}",
            "{\"sequence\":0,\"x\":1,\"y\":2,\"width\":3,\"height\":4,\"class\":\"fire\",\"colour\":1}",
            "{\"sequence\":",
        ] {
            let (line, problem) = parse(&format!("{good}\n{bad}\n{good}")).unwrap_err();
            assert_eq!(line, 2, "{bad}: {problem}");
            assert!(!problem.is_empty());
        }
    }
}
