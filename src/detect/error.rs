//! Why a model is refused at load.

use std::path::PathBuf;

/// Why a model is refused at load (exit code 2).
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The file can't be read.
    #[error("model {path}: {source}", path = path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Empty, or larger than any model that belongs on a companion computer.
    #[error("model {path}: {bytes} bytes, allowed are 1 to {limit}", path = path.display())]
    FileSize {
        /// The file.
        path: PathBuf,
        /// Its size.
        bytes: u64,
        /// Largest that is read.
        limit: u64,
    },
    /// Not ONNX, or cut short.
    #[error("model {path}: not an ONNX file, or cut short: {reason}", path = path.display())]
    NotOnnx {
        /// The file.
        path: PathBuf,
        /// Where reading stopped.
        reason: String,
    },
    /// Another file than the one that was approved.
    #[error("model {path}: sha256 is {found}, the mission names {expected}", path = path.display())]
    Hash {
        /// The file.
        path: PathBuf,
        /// As configured.
        expected: String,
        /// Of the file.
        found: String,
    },
    /// Weights in another file, which the hash would not cover.
    #[error(
        "model {path}: weights {tensor:?} stand in another file ({location:?}); \
         export the model as one file", path = path.display()
    )]
    ExternalData {
        /// The file.
        path: PathBuf,
        /// Name of the tensor.
        tensor: String,
        /// Where it says its data are.
        location: String,
    },
    /// Neither configuration nor metadata name a family.
    #[error(
        "model {path}: no family in its metadata; name one in the mission, of {known}",
        path = path.display()
    )]
    FamilyUnknown {
        /// The file.
        path: PathBuf,
        /// Families that can be decoded.
        known: String,
    },
    /// A family that can't be decoded.
    #[error("model {path}: family {found:?} is not one of {known}", path = path.display())]
    FamilyUnsupported {
        /// The file.
        path: PathBuf,
        /// As its metadata say.
        found: String,
        /// Families that can be decoded.
        known: String,
    },
    /// Neither configuration nor metadata name the classes.
    #[error("model {path}: no class names in its metadata and none in the mission", path = path.display())]
    NoClassNames {
        /// The file.
        path: PathBuf,
    },
    /// A class that the mission has no policy for.
    #[error(
        "model {path}: class {class:?} has no policy; the mission knows {known}",
        path = path.display()
    )]
    ClassUnknown {
        /// The file.
        path: PathBuf,
        /// Name in the model.
        class: String,
        /// Names that have a policy.
        known: String,
    },
    /// No class of the model alarms.
    #[error("model {path}: no class means fire or smoke (classes: {names})", path = path.display())]
    NothingToDetect {
        /// The file.
        path: PathBuf,
        /// Its classes.
        names: String,
    },
    /// Metadata that can't be read.
    #[error("model {path}: metadata {key} is {value:?}, expected {expected}", path = path.display())]
    Metadata {
        /// The file.
        path: PathBuf,
        /// Key.
        key: String,
        /// Its value.
        value: String,
        /// What belongs there.
        expected: String,
    },
    /// Its input can't be fed.
    #[error(
        "model {path}: its input is {found}, needed is one input [1, 3, rows, columns] of 32-bit floats, \
         rows and columns fixed", path = path.display()
    )]
    Input {
        /// The file.
        path: PathBuf,
        /// What the file has.
        found: String,
    },
    /// No execution provider may run it.
    #[error("model {path}: the mission names no execution provider", path = path.display())]
    NoProvider {
        /// The file.
        path: PathBuf,
    },
    /// Its outputs are not the family's.
    #[error("model {path}: its output is {found}, a {family} model has {expected}", path = path.display())]
    Tensor {
        /// The file.
        path: PathBuf,
        /// Family that was claimed.
        family: &'static str,
        /// What the family has.
        expected: String,
        /// What the file has.
        found: String,
    },
    /// As many scores as names?
    #[error(
        "model {path}: {named} class names but {scored} score columns in its output",
        path = path.display()
    )]
    ClassCount {
        /// The file.
        path: PathBuf,
        /// Names.
        named: usize,
        /// Score columns.
        scored: i64,
    },
    /// Neither its tensors' shapes nor their values tell how to read them.
    #[error(
        "model {path}: its tensors do not show {what}; say so in the mission \
         (model.yolox_output = \"raw\", \"raw_boxes\" or \"decoded\")",
        path = path.display()
    )]
    Undecided {
        /// The file.
        path: PathBuf,
        /// What they do not show.
        what: &'static str,
    },
    /// ONNX Runtime can't run it: an operator or an opset that it lacks.
    #[error(
        "model {path}: ONNX Runtime refuses it (opsets {opsets}): {source}",
        path = path.display()
    )]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// Operator sets that the model asks for.
        opsets: String,
        /// What ONNX Runtime said.
        source: ort::Error,
    },
    /// It loads, and does not answer a grey picture as it should.
    #[error("model {path}: its first run failed: {source}", path = path.display())]
    SelfCheck {
        /// The file.
        path: PathBuf,
        /// What went wrong.
        source: super::DetectError,
    },
    /// ONNX Runtime's shared library is not there.
    #[error(
        "ONNX Runtime's shared library is missing; searched {}; `./x setup` installs it",
        searched.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(", ")
    )]
    RuntimeMissing {
        /// Paths that were looked at.
        searched: Vec<PathBuf>,
    },
    /// It is there, and is too old, broken or for another machine.
    #[error("ONNX Runtime {path} can't be used: {reason}; `./x setup` installs one that can", path = path.display())]
    RuntimeUnusable {
        /// The library.
        path: PathBuf,
        /// What the loader said.
        reason: String,
    },
}
