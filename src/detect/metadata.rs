//! What a model's metadata say: family, classes, thresholds, normalisation.

use super::family::{Colour, Family, Normalisation};
use super::{DetectorConfig, ModelError, ModelForm};
use std::collections::BTreeMap;
use std::path::Path;

/// Score that counts when neither the mission nor the model names one.
const DEFAULT_THRESHOLD: f64 = 0.4;

/// The metadata of one model file, with its path for refusals.
pub(super) struct Metadata<'a> {
    pub path: &'a Path,
    pub entries: &'a BTreeMap<String, String>,
}

impl Metadata<'_> {
    /// The configured family, or the one in the metadata (`family`; YOLOv8 exports say `task`).
    pub fn family(&self, configured: Option<Family>) -> Result<Family, ModelError> {
        if let Some(family) = configured {
            return Ok(family);
        }
        match self.entries.get("task").map(String::as_str) {
            Some("detect") => return Ok(Family::Yolov8),
            Some("segment") => return Ok(Family::Yolov8Seg),
            _ => {}
        }
        let path = || self.path.to_owned();
        let Some(found) = self.entries.get("family") else {
            return Err(ModelError::FamilyUnknown {
                path: path(),
                known: Family::known(),
            });
        };
        Family::from_name(found).ok_or_else(|| ModelError::FamilyUnsupported {
            path: path(),
            found: found.clone(),
            known: Family::known(),
        })
    }

    /// Class names in the order of the model's score columns.
    pub fn names(&self, configured: Option<&[String]>) -> Result<Vec<String>, ModelError> {
        if let Some(names) = configured {
            return Ok(names.to_vec());
        }
        let Some(text) = self.entries.get("names") else {
            return Err(ModelError::NoClassNames {
                path: self.path.to_owned(),
            });
        };
        let expected = "names as {\"0\": \"fire\", ..}, without a gap";
        parse_names(text).ok_or_else(|| self.malformed("names", text, expected))
    }

    /// Least score per class: the mission's, else the model's per class, else the model's one.
    pub fn thresholds(
        &self,
        names: &[String],
        config: &DetectorConfig,
    ) -> Result<Vec<f64>, ModelError> {
        if let Some(threshold) = config.threshold {
            return Ok(vec![threshold; names.len()]);
        }
        let one = self.number("threshold")?.unwrap_or(DEFAULT_THRESHOLD);
        let per_class: BTreeMap<String, f64> = self
            .json("thresholds", "a score per class")?
            .unwrap_or_default();
        let thresholds: Vec<f64> = names
            .iter()
            .map(|name| per_class.get(name).copied().unwrap_or(one))
            .collect();
        match thresholds
            .iter()
            .find(|threshold| !(0.01..=1.0).contains(*threshold))
        {
            Some(bad) => Err(self.malformed("threshold", &bad.to_string(), "0.01 to 1")),
            None => Ok(thresholds),
        }
    }

    /// The family's normalisation, changed by what the metadata say.
    pub fn normalisation(&self, family: Family) -> Result<Normalisation, ModelError> {
        let usual = family.normalisation();
        let expected = "three numbers, divisors above 0";
        let mean = self
            .json::<[f32; 3]>("mean", expected)?
            .unwrap_or(usual.mean);
        let std = self.json::<[f32; 3]>("std", expected)?.unwrap_or(usual.std);
        if mean.iter().any(|value| !value.is_finite())
            || std.iter().any(|value| value.is_nan() || *value <= 0.0)
        {
            return Err(self.malformed("mean, std", &format!("{mean:?}, {std:?}"), expected));
        }
        let colour = match self.entries.get("color").map(String::as_str) {
            None => usual.colour,
            Some("bgr") => Colour::Bgr,
            Some("rgb") => Colour::Rgb,
            Some(other) => return Err(self.malformed("color", other, "bgr or rgb")),
        };
        Ok(Normalisation { colour, mean, std })
    }

    /// What the shapes of its outputs do not tell: the mission's word, else the model's.
    pub fn form(&self, configured: &ModelForm) -> Result<ModelForm, ModelError> {
        let yolox_output = match (configured.yolox_output, self.entries.get("yolox_output")) {
            (None, Some(text)) => {
                let read = serde_json::from_value(text.as_str().into());
                let expected = "raw, raw_boxes or decoded";
                Some(read.map_err(|_| self.malformed("yolox_output", text, expected))?)
            }
            (told, _) => told,
        };
        let anchors = match &configured.anchors {
            None => self.json(
                "anchors",
                "three pairs [width, height] a stride, finest first",
            )?,
            told => told.clone(),
        };
        Ok(ModelForm {
            yolox_output,
            anchors,
        })
    }

    fn number(&self, key: &str) -> Result<Option<f64>, ModelError> {
        self.json(key, "a number")
    }

    fn json<T: serde::de::DeserializeOwned>(
        &self,
        key: &str,
        expected: &str,
    ) -> Result<Option<T>, ModelError> {
        let Some(text) = self.entries.get(key) else {
            return Ok(None);
        };
        serde_json::from_str(text)
            .map(Some)
            .map_err(|_| self.malformed(key, text, expected))
    }

    fn malformed(&self, key: &str, value: &str, expected: &str) -> ModelError {
        ModelError::Metadata {
            path: self.path.to_owned(),
            key: key.to_owned(),
            value: value.to_owned(),
            expected: expected.to_owned(),
        }
    }
}

/// Names from a JSON object or list, or from the dict that Python exporters print
/// (`{0: 'fire', 1: 'smoke'}`).
fn parse_names(text: &str) -> Option<Vec<String>> {
    if let Ok(names) = serde_json::from_str::<Vec<String>>(text) {
        return (!names.is_empty()).then_some(names);
    }
    let numbered = match serde_json::from_str::<BTreeMap<usize, String>>(text) {
        Ok(numbered) => numbered,
        Err(_) => parse_python_dict(text)?,
    };
    let complete = !numbered.is_empty() && numbered.keys().copied().eq(0..numbered.len());
    complete.then(|| numbered.into_values().collect())
}

fn parse_python_dict(text: &str) -> Option<BTreeMap<usize, String>> {
    let inner = text.trim().strip_prefix('{')?.strip_suffix('}')?;
    let entry = |part: &str| {
        let (number, name) = part.split_once(':')?;
        let name = name.trim();
        let quoted =
            name.len() >= 2 && name.starts_with(['\'', '"']) && name.ends_with(['\'', '"']);
        let name = quoted.then(|| name[1..name.len() - 1].to_owned())?;
        Some((number.trim().parse().ok()?, name))
    };
    inner.split(',').map(entry).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read_as_exporters_write_them() {
        let both = ["fire".to_owned(), "smoke".to_owned()];
        for text in [
            r#"{"0": "fire", "1": "smoke"}"#,
            r#"["fire", "smoke"]"#,
            "{0: 'fire', 1: 'smoke'}",
            "{1: 'smoke', 0: 'fire'}",
        ] {
            assert_eq!(
                parse_names(text).as_deref(),
                Some(both.as_slice()),
                "{text}"
            );
        }
        for text in [
            "",
            "{}",
            "[]",
            "{0: 'fire', 2: 'smoke'}",
            "{0: fire}",
            "fire",
        ] {
            assert_eq!(parse_names(text), None, "{text}");
        }
    }

    #[test]
    fn the_missions_threshold_wins_over_the_models() {
        let entries = BTreeMap::from([
            ("threshold".to_owned(), "0.40".to_owned()),
            ("thresholds".to_owned(), r#"{"smoke": 0.5}"#.to_owned()),
        ]);
        let metadata = Metadata {
            path: Path::new("m.onnx"),
            entries: &entries,
        };
        let names = ["fire".to_owned(), "smoke".to_owned()];
        let mut config = DetectorConfig::new("m.onnx");
        assert_eq!(metadata.thresholds(&names, &config).unwrap(), [0.4, 0.5]);
        config.threshold = Some(0.3);
        assert_eq!(metadata.thresholds(&names, &config).unwrap(), [0.3, 0.3]);
    }

    #[test]
    fn malformed_metadata_are_named_with_key_and_value() {
        let entries = BTreeMap::from([("mean".to_owned(), "grey".to_owned())]);
        let metadata = Metadata {
            path: Path::new("m.onnx"),
            entries: &entries,
        };
        let message = metadata
            .normalisation(Family::NanodetPlus)
            .unwrap_err()
            .to_string();
        assert!(
            message.contains("mean") && message.contains("grey"),
            "{message}"
        );
    }
}
