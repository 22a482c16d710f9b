//! A detector that runs an ONNX model.

use super::family::{Head, InputSize, ShapeProblem};
use super::metadata::Metadata;
use super::model_file::{self, ModelFile};
use super::nms::{self, Candidate};
use super::preprocess::{Painter, View, plan};
use super::runtime::runtime;
use super::{
    ClassPolicy, DetectError, Detection, Detector, DetectorConfig, Family, LeftImage, ModelError,
};
use opencv::core::{CV_8UC3, Mat, MatTraitConst, Scalar};
use ort::session::Session;
use ort::value::{Outlet, TensorElementType, TensorRef};
use std::path::Path;

/// One class of a loaded model.
#[derive(Debug, Clone, PartialEq)]
pub struct ClassInfo {
    /// As the model names it.
    pub name: String,
    /// What it means to the mission.
    pub policy: ClassPolicy,
    /// Least score that counts.
    pub threshold: f64,
}

/// What was loaded and what runs it, for reports.
#[derive(Debug, Clone, PartialEq)]
pub struct DetectorInfo {
    /// How its tensors are read.
    pub family: Family,
    /// The network's input: columns, rows.
    pub input_px: (usize, usize),
    /// Its classes, in its order.
    pub classes: Vec<ClassInfo>,
    /// What computes it. Nothing but the processor is offered to ONNX Runtime, so this is what runs.
    pub execution_provider: &'static str,
    /// Version of the shared library.
    pub onnxruntime_version: String,
    /// Hash of the model file, hexadecimal.
    pub sha256: String,
    /// Operator sets that the model uses.
    pub opsets: String,
    /// Threads of one inference.
    pub threads: usize,
}

/// Runs an ONNX model over the whole frame and its tiles. One inference at a time, batch 1.
pub struct OnnxDetector {
    config: DetectorConfig,
    info: DetectorInfo,
    session: Session,
    input: InputSize,
    output_shapes: Vec<Vec<i64>>,
    head: Box<dyn Head>,
    floors: Vec<f32>,
    painter: Painter,
    /// Views of the image size that came last.
    plan: ((u32, u32), Vec<View>),
}

impl OnnxDetector {
    /// Loads a model, checks it against its family and the mission, and runs it once.
    ///
    /// # Errors
    /// [`ModelError`] that names the file, what was expected and what was found.
    pub fn load(config: &DetectorConfig) -> Result<Self, ModelError> {
        let path = config.model.as_path();
        let file = model_file::read(path, config.sha256.as_deref())?;
        let metadata = Metadata {
            path,
            entries: &file.metadata,
        };
        let family = metadata.family(config.family)?;
        let classes = classes(&metadata, config)?;
        let normalisation = metadata.normalisation(family)?;
        let runtime = runtime()?;
        let session = open(&runtime.environment, path, &file, config.threads)?;
        let tensors = Tensors { path, family };
        let input = tensors.input(session.inputs())?;
        let output_shapes = tensors.outputs(session.outputs())?;
        let head = family
            .head(input, classes.len(), &output_shapes)
            .map_err(|problem| tensors.refuse(problem, classes.len()))?;
        let mut detector = Self {
            floors: classes.iter().map(|class| class.threshold as f32).collect(),
            info: DetectorInfo {
                family,
                input_px: (input.width, input.height),
                classes,
                execution_provider: "CPUExecutionProvider",
                onnxruntime_version: runtime.version,
                sha256: file.sha256,
                opsets: file.opsets,
                threads: config.threads,
            },
            config: config.clone(),
            session,
            input,
            output_shapes,
            head,
            painter: Painter::new(input, normalisation),
            plan: ((0, 0), Vec::new()),
        };
        detector
            .self_check()
            .map_err(|source| ModelError::SelfCheck {
                path: path.to_owned(),
                source,
            })?;
        Ok(detector)
    }

    /// What was loaded.
    #[must_use]
    pub fn info(&self) -> &DetectorInfo {
        &self.info
    }

    /// Looks at a grey picture: warms the session up and shows that the answer is finite and shaped
    /// as promised.
    fn self_check(&mut self) -> Result<(), DetectError> {
        let (width, height) = (self.input.width as i32, self.input.height as i32);
        let grey = Mat::new_rows_cols_with_default(height, width, CV_8UC3, Scalar::all(114.0))?;
        self.detect_in(&grey).map(|_| ())
    }

    fn detect_in(&mut self, bgr: &Mat) -> Result<Vec<Detection>, DetectError> {
        let size = (bgr.cols().max(0) as u32, bgr.rows().max(0) as u32);
        if self.plan.0 != size {
            let views = plan(
                size,
                self.input,
                self.config.tile_px,
                self.config.overlap_px,
            );
            self.plan = (size, views);
        }
        let mut candidates = Vec::new();
        for index in 0..self.plan.1.len() {
            self.look(bgr, index, &mut candidates)?;
        }
        Ok(nms::merge(candidates, self.config.nms_iou))
    }

    /// One view: paint, run, decode, map back.
    fn look(
        &mut self,
        bgr: &Mat,
        index: usize,
        candidates: &mut Vec<Candidate>,
    ) -> Result<(), DetectError> {
        let view = self.plan.1[index];
        self.painter.paint(bgr, &view)?;
        let shape = [1, 3, self.input.height, self.input.width];
        let tensor = TensorRef::from_array_view((shape, self.painter.tensor.as_slice()))?;
        let answer = self.session.run(ort::inputs![tensor])?;
        let answers: Vec<_> = answer.values().collect();
        let mut outputs = Vec::with_capacity(answers.len());
        for (value, expected) in answers.iter().zip(&self.output_shapes) {
            let (found, values) = value.try_extract_tensor::<f32>()?;
            if found[..] != expected[..] {
                return Err(DetectError::Shape {
                    expected: expected.clone(),
                    found: found.to_vec(),
                });
            }
            check_finite(values)?;
            outputs.push(values);
        }
        let boxes = self.head.decode(&outputs, &self.floors);
        candidates.extend(boxes.iter().filter_map(|found| {
            let seen = view.to_raw(found)?;
            Some(Candidate {
                class: self.info.classes[found.class].policy.class()?,
                score: f64::from(found.score),
                box_px: seen.box_px,
                view: index,
                scale: view.scale(),
                cut: seen.cut,
            })
        }));
        Ok(())
    }
}

impl Detector for OnnxDetector {
    fn detect(&mut self, image: &LeftImage) -> Result<Vec<Detection>, DetectError> {
        if image.bgr.typ() != CV_8UC3 || image.bgr.dims() != 2 || image.bgr.empty() {
            let (rows, columns) = (image.bgr.rows(), image.bgr.cols());
            let kind = opencv::core::type_to_string(image.bgr.typ())?;
            return Err(DetectError::Image {
                found: format!("{columns}x{rows} {kind}"),
            });
        }
        self.detect_in(&image.bgr)
    }
}

fn open(
    environment: &ort::environment::Environment,
    path: &Path,
    file: &ModelFile,
    threads: usize,
) -> Result<Session, ModelError> {
    let commit = || -> ort::Result<Session> {
        // Spinning threads keep cores busy between frames for a millisecond's gain.
        Session::builder(environment)?
            .with_intra_threads(threads)?
            .with_intra_op_spinning(false)?
            .commit_from_memory(&file.bytes)
    };
    commit().map_err(|source| ModelError::Unsupported {
        path: path.to_owned(),
        opsets: file.opsets.clone(),
        source,
    })
}

fn classes(metadata: &Metadata, config: &DetectorConfig) -> Result<Vec<ClassInfo>, ModelError> {
    let names = metadata.names(config.names.as_deref())?;
    let thresholds = metadata.thresholds(&names, config)?;
    let path = || metadata.path.to_owned();
    let class = |(name, threshold): (&String, f64)| match config.classes.get(name) {
        Some(policy) => Ok(ClassInfo {
            name: name.clone(),
            policy: *policy,
            threshold,
        }),
        None => Err(ModelError::ClassUnknown {
            path: path(),
            class: name.clone(),
            known: config
                .classes
                .keys()
                .cloned()
                .collect::<Vec<_>>()
                .join(", "),
        }),
    };
    let classes: Vec<_> = names
        .iter()
        .zip(thresholds)
        .map(class)
        .collect::<Result<_, _>>()?;
    let alarms = |class: &ClassInfo| matches!(class.policy, ClassPolicy::Fire | ClassPolicy::Smoke);
    if !classes.iter().any(alarms) {
        return Err(ModelError::NothingToDetect {
            path: path(),
            names: names.join(", "),
        });
    }
    Ok(classes)
}

/// Checks a model's tensors as ONNX Runtime sees them.
struct Tensors<'a> {
    path: &'a Path,
    family: Family,
}

impl Tensors<'_> {
    /// Exactly one input, `[1, 3, rows, columns]`, 32-bit float, of fixed size.
    fn input(&self, inputs: &[Outlet]) -> Result<InputSize, ModelError> {
        let expected = "one input [1, 3, rows, columns] of 32-bit floats, rows and columns fixed";
        let refuse =
            |found: String| self.mismatch("its input".to_owned(), expected.to_owned(), found);
        let [input] = inputs else {
            return Err(refuse(describe_all(inputs)));
        };
        let size = |length: i64| {
            usize::try_from(length)
                .ok()
                .filter(|l| (32..=4096).contains(l))
        };
        match float_shape(input).as_deref() {
            Some(&[1 | -1, 3, rows, columns]) => match (size(columns), size(rows)) {
                (Some(width), Some(height)) => Ok(InputSize { width, height }),
                _ => Err(refuse(describe(input))),
            },
            _ => Err(refuse(describe(input))),
        }
    }

    /// Shapes of the outputs, all 32-bit float; a free batch axis reads as 1.
    fn outputs(&self, outputs: &[Outlet]) -> Result<Vec<Vec<i64>>, ModelError> {
        let shape = |output: &Outlet| match float_shape(output) {
            Some(mut shape) => {
                if let Some(batch) = shape.first_mut().filter(|batch| **batch == -1) {
                    *batch = 1;
                }
                Ok(shape)
            }
            None => Err(self.mismatch(
                "an output".to_owned(),
                "tensors of 32-bit floats".to_owned(),
                describe(output),
            )),
        };
        outputs.iter().map(shape).collect()
    }

    fn refuse(&self, problem: ShapeProblem, named: usize) -> ModelError {
        match problem {
            ShapeProblem::ClassCount { scored } => ModelError::ClassCount {
                path: self.path.to_owned(),
                named,
                scored,
            },
            ShapeProblem::Output { expected, found } => {
                self.mismatch("its output".to_owned(), expected, found)
            }
        }
    }

    fn mismatch(&self, what: String, expected: String, found: String) -> ModelError {
        let (path, family) = (self.path.to_owned(), self.family.name());
        ModelError::Tensor {
            path,
            family,
            what,
            expected,
            found,
        }
    }
}

fn float_shape(outlet: &Outlet) -> Option<Vec<i64>> {
    let dtype = outlet.dtype();
    let shape = dtype.tensor_shape()?;
    (dtype.tensor_type()? == TensorElementType::Float32).then(|| shape.to_vec())
}

fn describe(outlet: &Outlet) -> String {
    format!("{} {}", outlet.name(), outlet.dtype())
}

fn describe_all(outlets: &[Outlet]) -> String {
    outlets
        .iter()
        .map(describe)
        .collect::<Vec<_>>()
        .join(" and ")
}

/// NaN and infinity have all exponent bits set; integers let the compiler look at many at once.
fn check_finite(values: &[f32]) -> Result<(), DetectError> {
    const EXPONENT: u32 = 0x7f80_0000;
    let bad = |value: &f32| u32::from(value.to_bits() & EXPONENT == EXPONENT);
    match values.iter().map(bad).sum::<u32>() {
        0 => Ok(()),
        count => Err(DetectError::NotFinite {
            count: count as usize,
            of: values.len(),
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::detect::lookalike::Lookalike;
    use crate::detect::{BoxPx, DetectionClass};
    use emberfix_frames::ServiceTime;

    /// Where this machine has ONNX Runtime, `ORT_DYLIB_PATH` points to it (`.cargo/config.toml`);
    /// `./x test` sees to that. Without it these tests say so and pass.
    fn no_runtime() -> bool {
        let missing = matches!(runtime(), Err(ModelError::RuntimeMissing { .. }));
        if missing {
            eprintln!("skipped: no ONNX Runtime");
        }
        missing
    }

    fn load(model: &Lookalike) -> Result<OnnxDetector, ModelError> {
        load_with(model, |_| ())
    }

    fn load_with(
        model: &Lookalike,
        change: impl FnOnce(&mut DetectorConfig),
    ) -> Result<OnnxDetector, ModelError> {
        let file = model.write();
        let mut config = DetectorConfig::new(file.path());
        change(&mut config);
        OnnxDetector::load(&config)
    }

    fn refusal(model: &Lookalike) -> String {
        load(model)
            .err()
            .map(|error| error.to_string())
            .unwrap_or_else(|| "loaded".to_owned())
    }

    fn grey(width: i32, height: i32) -> LeftImage {
        let bgr =
            Mat::new_rows_cols_with_default(height, width, CV_8UC3, Scalar::all(90.0)).unwrap();
        LeftImage {
            at: ServiceTime::from_unix_ns(0),
            sequence: 0,
            bgr,
        }
    }

    #[test]
    fn a_models_box_comes_out_in_raw_pixels() {
        if no_runtime() {
            return;
        }
        // Stride 16, column 10, row 13: middle (160, 208), 2 x 2 strides each way.
        let model = Lookalike::nanodet_plus().with_box(2704 + 13 * 26 + 10, 0, 0.9, 2);
        let mut detector = load_with(&model, |config| config.tile_px = None).unwrap();
        let found = detector.detect(&grey(1280, 720)).unwrap();
        assert_eq!(found.len(), 1);
        assert_eq!(found[0].class, DetectionClass::Fire);
        // Scale 0.325, bars of 91 rows: (128 - 0) / 0.325 - 0.5, (176 - 91) / 0.325 - 0.5, 64 / 0.325.
        let BoxPx {
            x,
            y,
            width,
            height,
        } = found[0].box_px;
        for (got, want) in [
            (x, 393.346),
            (y, 261.038),
            (width, 196.923),
            (height, 196.923),
        ] {
            assert!((got - want).abs() < 1e-3, "{:?}", found[0].box_px);
        }
        assert_eq!(detector.info().execution_provider, "CPUExecutionProvider");
        assert_eq!(detector.info().input_px, (416, 416));
    }

    #[test]
    fn every_tile_is_looked_at() {
        if no_runtime() {
            return;
        }
        let model = Lookalike::nanodet_plus()
            .with_box(2704 + 13 * 26 + 13, 1, 0.9, 0)
            .with_box(26 * 52 + 26, 0, 0.8, 1);
        let found = load(&model).unwrap().detect(&grey(1280, 720)).unwrap();
        // The same answer nine times: one per view, none at the same place.
        assert_eq!(found.len(), 9, "{found:?}");
    }

    #[test]
    fn what_is_not_finite_is_refused_at_load() {
        if no_runtime() {
            return;
        }
        for bad in [f32::NAN, f32::INFINITY] {
            let mut model = Lookalike::nanodet_plus();
            model.answer[99] = bad;
            assert!(
                refusal(&model).contains("not finite"),
                "{}",
                refusal(&model)
            );
        }
    }

    #[test]
    fn tensors_of_another_family_are_refused_with_both_shapes() {
        if no_runtime() {
            return;
        }
        let model = Lookalike::nanodet_plus();
        let claimed = load_with(&model, |config| config.family = Some(Family::Yolov8));
        let message = claimed.err().unwrap().to_string();
        assert!(
            message.contains("[1, 3598, 34]") && message.contains("3549"),
            "{message}"
        );

        let three = r#"["fire", "smoke", "other"]"#.to_owned();
        let mut model = Lookalike::nanodet_plus();
        model.metadata[1].1 = three;
        assert!(
            refusal(&model).contains("3 class names but 2 score columns"),
            "{}",
            refusal(&model)
        );

        for (input, input_type) in [
            (vec![1, 416, 416, 3], 1),
            (vec![1, 3, 416, 416], 2),
            (vec![1, 1, 416, 416], 1),
            (vec![3, 416, 416], 1),
            (vec![4, 3, 416, 416], 1),
        ] {
            let model = Lookalike {
                input,
                input_type,
                ..Lookalike::nanodet_plus()
            };
            assert!(
                refusal(&model).contains("one input [1, 3, rows, columns]"),
                "{}",
                refusal(&model)
            );
        }
    }

    #[test]
    fn an_operator_or_opset_that_the_runtime_lacks_is_named() {
        if no_runtime() {
            return;
        }
        let operator = Lookalike {
            operator: "Ignite",
            ..Lookalike::nanodet_plus()
        };
        assert!(
            refusal(&operator).contains("Ignite"),
            "{}",
            refusal(&operator)
        );
        let opset = Lookalike {
            opset: 999,
            ..Lookalike::nanodet_plus()
        };
        assert!(
            refusal(&opset).contains("ai.onnx 999"),
            "{}",
            refusal(&opset)
        );
    }

    #[test]
    fn metadata_that_name_no_known_class_or_family_are_refused() {
        let mut model = Lookalike::nanodet_plus();
        model.metadata[1].1 = r#"["fire", "dragon"]"#.to_owned();
        assert!(refusal(&model).contains("dragon"));
        model.metadata[1].1 = r#"["other", "non-fire"]"#.to_owned();
        assert!(refusal(&model).contains("no class means fire or smoke"));
        model.metadata[0].1 = "retinanet".to_owned();
        assert!(refusal(&model).contains("nanodet-plus, yolov8"));
        model.metadata.clear();
        assert!(refusal(&model).contains("no family"));
    }

    #[test]
    fn a_grey_scale_or_empty_image_is_an_error_of_that_frame_only() {
        if no_runtime() {
            return;
        }
        let mut detector = load(&Lookalike::nanodet_plus()).unwrap();
        let mut image = grey(64, 64);
        image.bgr =
            Mat::new_rows_cols_with_default(64, 64, opencv::core::CV_8UC1, Scalar::all(0.0))
                .unwrap();
        let error = detector.detect(&image).unwrap_err();
        assert_eq!(
            error.to_string(),
            "image is 64x64 CV_8UC1, the detector reads 8-bit BGR"
        );
        image.bgr = Mat::default();
        assert!(detector.detect(&image).is_err());
        assert!(detector.detect(&grey(640, 480)).unwrap().is_empty());
        assert!(detector.detect(&grey(1, 1)).unwrap().is_empty());
    }

    #[test]
    fn one_nan_among_many_drops_the_frame() {
        let mut values = vec![0.5_f32; 1000];
        assert!(check_finite(&values).is_ok());
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            values[777] = bad;
            let error = check_finite(&values).unwrap_err();
            assert!(matches!(
                error,
                DetectError::NotFinite { count: 1, of: 1000 }
            ));
        }
        values[777] = f32::MAX;
        assert!(check_finite(&values).is_ok());
    }
}
