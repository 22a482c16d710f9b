//! One model in ONNX Runtime: a session, its input, and what runs it.

use super::family::{InputSize, Output};
use super::model_file::ModelFile;
use super::runtime::Runtime;
use super::{DetectError, ModelError};
use ort::ep::{CUDA, ExecutionProviderDispatch, OpenVINO, TensorRT};
use ort::session::Session;
use ort::value::{Outlet, TensorElementType, TensorRef};
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::time::Instant;

/// What may compute a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Provider {
    /// The processor.
    Cpu,
    /// An NVIDIA GPU by CUDA.
    Cuda,
    /// An NVIDIA GPU by TensorRT.
    Tensorrt,
    /// Intel's processors and GPUs.
    Openvino,
}

impl Provider {
    /// As ONNX Runtime names it.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Cpu => "CPUExecutionProvider",
            Self::Cuda => "CUDAExecutionProvider",
            Self::Tensorrt => "TensorrtExecutionProvider",
            Self::Openvino => "OpenVINOExecutionProvider",
        }
    }

    fn dispatch(self) -> Option<ExecutionProviderDispatch> {
        let provider = match self {
            Self::Cpu => return None,
            Self::Cuda => CUDA::default().build(),
            Self::Tensorrt => TensorRT::default().build(),
            Self::Openvino => OpenVINO::default().build(),
        };
        Some(provider.error_on_failure())
    }
}

/// A provider that was asked for and does not run the model, and why.
pub type PassedOver = (Provider, String);

/// A model that runs.
pub(super) struct Network {
    session: Session,
    pub input: InputSize,
    pub provider: Provider,
    pub passed_over: Vec<PassedOver>,
}

impl Network {
    /// Opens a model with the first of the providers that takes all of it.
    pub fn open(
        runtime: &Runtime,
        path: &Path,
        file: &ModelFile,
        threads: usize,
        providers: &[Provider],
    ) -> Result<Self, ModelError> {
        let mut passed_over = Vec::new();
        let mut refused = None;
        for &provider in providers {
            match session(runtime, file, threads, provider) {
                Ok(session) => {
                    let input = input_size(path, session.inputs())?;
                    return Ok(Self {
                        session,
                        input,
                        provider,
                        passed_over,
                    });
                }
                Err(error) => {
                    passed_over.push((provider, error.to_string()));
                    refused = Some(error);
                }
            }
        }
        let path = path.to_owned();
        Err(match refused {
            Some(source) => ModelError::Unsupported {
                path,
                opsets: file.opsets.clone(),
                source,
            },
            None => ModelError::NoProvider { path },
        })
    }

    /// Runs a batch of one, and lets `read` see the outputs; says too when the answer was there. All
    /// outputs are 32-bit floats, finite.
    pub fn run<T>(
        &mut self,
        tensor: &[f32],
        read: impl FnOnce(&[Output<'_>]) -> T,
    ) -> Result<(T, Instant), DetectError> {
        let shape = [1, 3, self.input.height, self.input.width];
        let tensor = TensorRef::from_array_view((shape, tensor))?;
        let answer = self.session.run(ort::inputs![tensor])?;
        let answered = Instant::now();
        let values: Vec<_> = answer.values().collect();
        let mut outputs = Vec::with_capacity(values.len());
        for value in &values {
            let (shape, values) = value.try_extract_tensor::<f32>()?;
            check_finite(values)?;
            outputs.push(Output { shape, values });
        }
        Ok((read(&outputs), answered))
    }
}

/// A session that this provider runs all by itself: what it can't compute makes opening fail, and
/// never moves to the processor unsaid.
fn session(
    runtime: &Runtime,
    file: &ModelFile,
    threads: usize,
    provider: Provider,
) -> ort::Result<Session> {
    // Spinning threads keep cores busy between frames for a millisecond's gain.
    let builder = Session::builder(&runtime.environment)?
        .with_intra_threads(threads)?
        .with_intra_op_spinning(false)?;
    let mut builder = match provider.dispatch() {
        None => builder,
        Some(dispatch) => builder
            .with_execution_providers([dispatch])?
            .with_config_entry("session.disable_cpu_ep_fallback", "1")?,
    };
    builder.commit_from_memory(&file.bytes)
}

/// Exactly one input, `[1, 3, rows, columns]`, 32-bit float, of fixed size.
fn input_size(path: &Path, inputs: &[Outlet]) -> Result<InputSize, ModelError> {
    let refuse = || ModelError::Input {
        path: path.to_owned(),
        found: inputs
            .iter()
            .map(|input| format!("{} {}", input.name(), input.dtype()))
            .collect::<Vec<_>>()
            .join(" and "),
    };
    let size = |length: i64| {
        let length = usize::try_from(length).ok();
        length.filter(|length| (32..=4096).contains(length))
    };
    let [input] = inputs else {
        return Err(refuse());
    };
    match float_shape(input) {
        Some(&[1 | -1, 3, rows, columns]) => match (size(columns), size(rows)) {
            (Some(width), Some(height)) => Ok(InputSize { width, height }),
            _ => Err(refuse()),
        },
        _ => Err(refuse()),
    }
}

fn float_shape(outlet: &Outlet) -> Option<&[i64]> {
    let dtype = outlet.dtype();
    let shape = dtype.tensor_shape()?;
    (dtype.tensor_type()? == TensorElementType::Float32).then_some(shape)
}

/// NaN and infinity have all exponent bits set; integers let the compiler look at many at once.
pub(super) fn check_finite(values: &[f32]) -> Result<(), DetectError> {
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
