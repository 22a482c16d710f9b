//! A detector that runs an ONNX model.

use super::attention::{Attention, Looked};
use super::family::{Head, HeadProblem, ModelShape, Output};
use super::metadata::Metadata;
use super::model_file;
use super::network::{Network, PassedOver};
use super::nms::{self, Candidate};
use super::preprocess::{Painter, View, plan};
use super::runtime::runtime;
use super::{
    ClassPolicy, DetectError, Detection, Detector, DetectorConfig, Family, LeftImage, ModelError,
};
use opencv::core::{CV_8UC3, Mat, MatTraitConst, Scalar};
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

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
    /// What computes it, all of it.
    pub execution_provider: &'static str,
    /// Providers that were to come first and do not run it, and why.
    pub passed_over: Vec<PassedOver>,
    /// Version of the shared library.
    pub onnxruntime_version: String,
    /// Hash of the model file, hexadecimal.
    pub sha256: String,
    /// Operator sets that the model uses.
    pub opsets: String,
    /// Threads of one inference.
    pub threads: usize,
    /// Views that fit into the time for an image, where it is bounded.
    pub views_per_frame: Option<usize>,
}

/// Where a detector's time went.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Spent {
    /// Pictures to tensors.
    pub before: Duration,
    /// ONNX Runtime.
    pub inference: Duration,
    /// Tensors to detections.
    pub after: Duration,
    /// Views looked at.
    pub views: u32,
}

impl Spent {
    /// Time before and after inference, as a share of inference.
    #[must_use]
    pub fn overhead(&self) -> Option<f64> {
        let inference = self.inference.as_secs_f64();
        (inference > 0.0).then(|| (self.before + self.after).as_secs_f64() / inference)
    }
}

impl std::ops::Sub for Spent {
    type Output = Self;

    /// What was spent since `earlier`.
    fn sub(self, earlier: Self) -> Self {
        Self {
            before: self.before - earlier.before,
            inference: self.inference - earlier.inference,
            after: self.after - earlier.after,
            views: self.views - earlier.views,
        }
    }
}

/// Runs an ONNX model over the whole frame and its tiles. One inference at a time, batch 1.
pub struct OnnxDetector {
    config: DetectorConfig,
    info: DetectorInfo,
    network: Network,
    /// Shapes of the outputs, as in the first answer.
    output_shapes: Vec<Vec<i64>>,
    head: Box<dyn Head>,
    floors: Vec<f32>,
    painter: Painter,
    /// Views of the image size that came last.
    plan: Plan,
    spent: Spent,
}

/// The views of one image size, and what they have waited for.
#[derive(Default)]
struct Plan {
    size: (u32, u32),
    views: Vec<View>,
    attention: Attention,
    looked: Looked,
}

/// Looks by which a model's speed is known.
const TIMED_LOOKS: usize = 5;

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
        let form = metadata.form(&config.form)?;
        let normalisation = metadata.normalisation(family)?;
        let runtime = runtime()?;
        let mut network = Network::open(&runtime, path, &file, config.threads, &config.providers)?;
        let mut painter = Painter::new(network.input, normalisation);
        let model = ModelShape {
            input: network.input,
            classes: classes.len(),
            form: &form,
        };
        let first = first_answer(&mut network, &mut painter, |outputs| {
            let shapes = outputs.iter().map(|output| output.shape.to_vec());
            (family.head(&model, outputs), shapes.collect())
        });
        let failed = |source| ModelError::SelfCheck {
            path: path.to_owned(),
            source,
        };
        let (head, output_shapes) = first.map_err(failed)?;
        let views_per_frame = config
            .frame_budget_ms
            .map(|budget_ms| views_within(budget_ms, &mut network, &mut painter))
            .transpose()
            .map_err(failed)?;
        Ok(Self {
            floors: classes.iter().map(|class| class.threshold as f32).collect(),
            head: head.map_err(|problem| refusal(path, family, classes.len(), problem))?,
            info: DetectorInfo {
                family,
                input_px: (network.input.width, network.input.height),
                classes,
                execution_provider: network.provider.name(),
                passed_over: network.passed_over.clone(),
                onnxruntime_version: runtime.version,
                sha256: file.sha256,
                opsets: file.opsets,
                threads: config.threads,
                views_per_frame,
            },
            config: config.clone(),
            network,
            output_shapes,
            painter,
            plan: Plan::default(),
            spent: Spent::default(),
        })
    }

    /// What was loaded.
    #[must_use]
    pub fn info(&self) -> &DetectorInfo {
        &self.info
    }

    /// Where the time of all images so far went.
    #[must_use]
    pub fn spent(&self) -> Spent {
        self.spent
    }

    fn detect_in(&mut self, image: &LeftImage) -> Result<Vec<Detection>, DetectError> {
        let bgr = &image.bgr;
        let size = (bgr.cols().max(0) as u32, bgr.rows().max(0) as u32);
        if self.plan.size != size {
            let (tile_px, overlap_px) = (self.config.tile_px, self.config.overlap_px);
            let views = plan(size, self.network.input, tile_px, overlap_px);
            self.plan = Plan {
                size,
                attention: Attention::new(views.len()),
                views,
                looked: Looked::default(),
            };
        }
        let Plan {
            views, attention, ..
        } = &mut self.plan;
        let most = self.info.views_per_frame;
        let mut candidates = Vec::new();
        let chosen = attention.choose(views, image.ground.as_ref(), most);
        self.plan.looked = Looked::at(&self.plan.views, &chosen);
        for index in chosen {
            let found = self.look(bgr, index)?;
            self.plan.attention.note(index, !found.is_empty());
            candidates.extend(found);
        }
        let merging = Instant::now();
        let found = nms::merge(candidates, self.config.nms_iou);
        self.spent.after += merging.elapsed();
        Ok(found)
    }

    /// One view: paint, run, decode, map back.
    fn look(&mut self, bgr: &Mat, index: usize) -> Result<Vec<Candidate>, DetectError> {
        let view = self.plan.views[index];
        let painting = Instant::now();
        self.painter.paint(bgr, &view)?;
        let running = Instant::now();
        let reader = Reader {
            head: self.head.as_ref(),
            shapes: &self.output_shapes,
            floors: &self.floors,
            classes: &self.info.classes,
            nms_iou: self.config.nms_iou,
        };
        let read = |outputs: &[Output<'_>]| reader.candidates(outputs, &view, index);
        let (candidates, answered) = self.network.run(&self.painter.tensor, read)?;
        self.spent.before += running - painting;
        self.spent.inference += answered - running;
        self.spent.after += answered.elapsed();
        self.spent.views += 1;
        candidates
    }
}

/// Looks at a grey picture: warms the session up and shows what its outputs are.
fn first_answer<T>(
    network: &mut Network,
    painter: &mut Painter,
    read: impl FnOnce(&[Output<'_>]) -> T,
) -> Result<T, DetectError> {
    let (width, height) = (network.input.width, network.input.height);
    let grey = Scalar::all(114.0);
    let grey = Mat::new_rows_cols_with_default(height as i32, width as i32, CV_8UC3, grey)?;
    let whole = plan((width as u32, height as u32), network.input, None, 0);
    painter.paint(&grey, &whole[0])?;
    Ok(network.run(&painter.tensor, read)?.0)
}

/// How many views fit into a time, at the median of some looks.
fn views_within(
    budget_ms: f64,
    network: &mut Network,
    painter: &mut Painter,
) -> Result<usize, DetectError> {
    let mut times_ms = Vec::with_capacity(TIMED_LOOKS);
    for _ in 0..TIMED_LOOKS {
        let begun = Instant::now();
        first_answer(network, painter, |_| ())?;
        times_ms.push(1e3 * begun.elapsed().as_secs_f64());
    }
    times_ms.sort_by(f64::total_cmp);
    let view_ms = times_ms[TIMED_LOOKS / 2];
    Ok(((budget_ms / view_ms) as usize).max(1))
}

/// What it takes to read one answer.
struct Reader<'a> {
    head: &'a dyn Head,
    shapes: &'a [Vec<i64>],
    floors: &'a [f32],
    classes: &'a [ClassInfo],
    nms_iou: f64,
}

impl Reader<'_> {
    /// What a view shows, in the raw image.
    fn candidates(
        &self,
        outputs: &[Output<'_>],
        view: &View,
        index: usize,
    ) -> Result<Vec<Candidate>, DetectError> {
        for (output, expected) in outputs.iter().zip(self.shapes) {
            if output.shape != expected.as_slice() {
                return Err(DetectError::Shape {
                    expected: expected.clone(),
                    found: output.shape.to_vec(),
                });
            }
        }
        let outputs: Vec<&[f32]> = outputs.iter().map(|output| output.values).collect();
        let boxes = self.head.decode(&outputs, self.floors);
        let candidates = boxes.iter().enumerate().filter_map(|(number, found)| {
            let seen = view.to_raw(found)?;
            Some(Candidate {
                class: self.classes[found.class].policy.class()?,
                score: f64::from(found.score),
                box_px: seen.box_px,
                mask: None,
                number,
                view: index,
                scale: view.scale(),
                cut: seen.cut,
            })
        });
        let mut kept = nms::within_view(candidates.collect(), self.nms_iou);
        for candidate in &mut kept {
            let logits = self.head.mask(&outputs, &boxes[candidate.number]);
            let mask = logits.map(|logits| view.mask_to_raw(&logits, &candidate.box_px));
            candidate.mask = mask.map(Arc::new);
        }
        Ok(kept)
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
        self.detect_in(image)
    }

    fn looked(&self) -> Looked {
        self.plan.looked.clone()
    }
}

fn refusal(path: &Path, family: Family, named: usize, problem: HeadProblem) -> ModelError {
    let path = path.to_owned();
    match problem {
        HeadProblem::ClassCount { scored } => ModelError::ClassCount {
            path,
            named,
            scored,
        },
        HeadProblem::Undecided { what } => ModelError::Undecided { path, what },
        HeadProblem::Output { expected, found } => ModelError::Tensor {
            path,
            family: family.name(),
            expected,
            found,
        },
    }
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::detect::lookalike::Lookalike;
    use crate::detect::{BoxPx, DetectionClass, Provider};
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
            ground: None,
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

    /// The shared library that `./x setup` installs runs on the processor alone.
    #[test]
    fn a_provider_that_does_not_run_the_model_is_passed_over_by_name_or_the_model_refused() {
        if no_runtime() {
            return;
        }
        let model = Lookalike::nanodet_plus();
        let with = |providers: &[Provider]| {
            load_with(&model, |config| config.providers = providers.to_vec())
        };
        let detector = with(&[Provider::Cuda, Provider::Openvino, Provider::Cpu]).unwrap();
        assert_eq!(detector.info().execution_provider, "CPUExecutionProvider");
        let passed_over = &detector.info().passed_over;
        let names: Vec<Provider> = passed_over.iter().map(|(provider, _)| *provider).collect();
        assert_eq!(names, [Provider::Cuda, Provider::Openvino]);
        assert!(passed_over.iter().all(|(_, why)| !why.is_empty()));
        assert!(with(&[Provider::Cuda]).is_err());
    }

    #[test]
    fn a_bounded_frame_looks_at_no_more_views_than_fit() {
        if no_runtime() {
            return;
        }
        let model = Lookalike::nanodet_plus();
        let bounded = |budget_ms| load_with(&model, |config| config.frame_budget_ms = budget_ms);
        // Nothing fits into a thousandth of a second but what must be looked at.
        let mut detector = bounded(Some(1e-3)).unwrap();
        assert_eq!(detector.info().views_per_frame, Some(1));
        detector.detect(&grey(1280, 720)).unwrap();
        assert_eq!(detector.spent().views, 1);
        assert!(!detector.looked().would_show((640.0, 360.0), 20.0));
        let mut detector = bounded(None).unwrap();
        detector.detect(&grey(1280, 720)).unwrap();
        assert_eq!(detector.spent().views, 9);
        assert!(detector.looked().would_show((640.0, 360.0), 20.0));
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
        assert!(refusal(&model).contains("nanodet-plus, yolov5"));
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
}
