//! The bytes of a model: read, bounded, hashed, and looked through before anything runs them.

use super::ModelError;
use prost::Message;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::Path;

/// Larger than any detector for a companion computer, smaller than its memory.
const MAX_BYTES: u64 = 256 * 1024 * 1024;

/// What the file says of itself.
#[derive(Debug)]
pub(super) struct ModelFile {
    pub bytes: Vec<u8>,
    pub sha256: String,
    pub metadata: BTreeMap<String, String>,
    /// Operator sets, such as `ai.onnx 17`.
    pub opsets: String,
}

/// Reads a model file and refuses what is empty, too large, not ONNX, not the approved one, or
/// leans on files beside it.
pub(super) fn read(path: &Path, sha256: Option<&str>) -> Result<ModelFile, ModelError> {
    let bytes = read_bounded(path)?;
    let found = hex(&Sha256::digest(&bytes));
    if let Some(expected) = sha256.filter(|expected| !expected.eq_ignore_ascii_case(&found)) {
        let expected = expected.to_owned();
        return Err(ModelError::Hash {
            path: path.to_owned(),
            expected,
            found,
        });
    }
    let model = parse(&bytes).map_err(|reason| ModelError::NotOnnx {
        path: path.to_owned(),
        reason,
    })?;
    if let Some(tensor) = model.external_tensor() {
        return Err(ModelError::ExternalData {
            path: path.to_owned(),
            tensor: tensor.name.clone(),
            location: tensor.location(),
        });
    }
    let metadata = model
        .metadata_props
        .iter()
        .map(|p| (p.key.clone(), p.value.clone()))
        .collect();
    Ok(ModelFile {
        sha256: found,
        metadata,
        opsets: model.opsets(),
        bytes,
    })
}

fn read_bounded(path: &Path) -> Result<Vec<u8>, ModelError> {
    let read = |source| ModelError::Read {
        path: path.to_owned(),
        source,
    };
    let bytes = std::fs::metadata(path).map_err(read)?.len();
    if bytes == 0 || bytes > MAX_BYTES {
        return Err(ModelError::FileSize {
            path: path.to_owned(),
            bytes,
            limit: MAX_BYTES,
        });
    }
    std::fs::read(path).map_err(read)
}

fn parse(bytes: &[u8]) -> Result<ModelProto, String> {
    let model = ModelProto::decode(bytes).map_err(|error| error.to_string())?;
    match (&model.graph, model.opset_import.is_empty()) {
        (None, _) => Err("it holds no graph".to_owned()),
        (_, true) => Err("it names no operator set".to_owned()),
        _ => Ok(model),
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

// The parts of onnx.proto (field numbers as published) that tell whether to trust a file. Unknown
// fields, the weights among them, are skipped; prost bounds the nesting.

#[derive(Message)]
struct ModelProto {
    #[prost(message, optional, boxed, tag = "7")]
    graph: Option<Box<GraphProto>>,
    #[prost(message, repeated, tag = "8")]
    opset_import: Vec<OpsetProto>,
    #[prost(message, repeated, tag = "14")]
    metadata_props: Vec<EntryProto>,
    #[prost(message, repeated, tag = "25")]
    functions: Vec<FunctionProto>,
}

#[derive(Message)]
struct OpsetProto {
    #[prost(string, tag = "1")]
    domain: String,
    #[prost(int64, tag = "2")]
    version: i64,
}

#[derive(Message)]
struct EntryProto {
    #[prost(string, tag = "1")]
    key: String,
    #[prost(string, tag = "2")]
    value: String,
}

#[derive(Message)]
struct GraphProto {
    #[prost(message, repeated, tag = "1")]
    node: Vec<NodeProto>,
    #[prost(message, repeated, tag = "5")]
    initializer: Vec<TensorProto>,
    #[prost(message, repeated, tag = "15")]
    sparse_initializer: Vec<SparseTensorProto>,
}

#[derive(Message)]
struct FunctionProto {
    #[prost(message, repeated, tag = "7")]
    node: Vec<NodeProto>,
}

#[derive(Message)]
struct NodeProto {
    #[prost(message, repeated, tag = "5")]
    attribute: Vec<AttributeProto>,
}

#[derive(Message)]
struct AttributeProto {
    #[prost(message, optional, tag = "5")]
    t: Option<TensorProto>,
    #[prost(message, optional, boxed, tag = "6")]
    g: Option<Box<GraphProto>>,
    #[prost(message, repeated, tag = "10")]
    tensors: Vec<TensorProto>,
    #[prost(message, repeated, tag = "11")]
    graphs: Vec<GraphProto>,
    #[prost(message, optional, tag = "22")]
    sparse_tensor: Option<SparseTensorProto>,
    #[prost(message, repeated, tag = "23")]
    sparse_tensors: Vec<SparseTensorProto>,
}

#[derive(Message)]
struct SparseTensorProto {
    #[prost(message, optional, tag = "1")]
    values: Option<TensorProto>,
    #[prost(message, optional, tag = "2")]
    indices: Option<TensorProto>,
}

#[derive(Message)]
struct TensorProto {
    #[prost(string, tag = "8")]
    name: String,
    #[prost(message, repeated, tag = "13")]
    external_data: Vec<EntryProto>,
    #[prost(int32, tag = "14")]
    data_location: i32,
}

impl ModelProto {
    fn external_tensor(&self) -> Option<&TensorProto> {
        let in_graph = self.graph.as_deref().and_then(GraphProto::external_tensor);
        in_graph.or_else(|| {
            let nodes = self.functions.iter().flat_map(|function| &function.node);
            nodes
                .flat_map(|node| &node.attribute)
                .find_map(AttributeProto::external_tensor)
        })
    }

    fn opsets(&self) -> String {
        let name = |set: &OpsetProto| match set.domain.as_str() {
            "" => format!("ai.onnx {}", set.version),
            domain => format!("{domain} {}", set.version),
        };
        self.opset_import
            .iter()
            .map(name)
            .collect::<Vec<_>>()
            .join(", ")
    }
}

impl GraphProto {
    fn external_tensor(&self) -> Option<&TensorProto> {
        let sparse = self
            .sparse_initializer
            .iter()
            .flat_map(SparseTensorProto::parts);
        let attributes = self.node.iter().flat_map(|node| &node.attribute);
        self.initializer
            .iter()
            .chain(sparse)
            .find(|tensor| tensor.is_external())
            .or_else(|| {
                attributes
                    .into_iter()
                    .find_map(AttributeProto::external_tensor)
            })
    }
}

impl AttributeProto {
    fn external_tensor(&self) -> Option<&TensorProto> {
        let sparse = self.sparse_tensor.iter().chain(&self.sparse_tensors);
        self.t
            .iter()
            .chain(&self.tensors)
            .chain(sparse.flat_map(SparseTensorProto::parts))
            .find(|tensor| tensor.is_external())
            .or_else(|| self.g.as_deref().and_then(GraphProto::external_tensor))
            .or_else(|| self.graphs.iter().find_map(GraphProto::external_tensor))
    }
}

impl SparseTensorProto {
    fn parts(&self) -> impl Iterator<Item = &TensorProto> {
        self.values.iter().chain(&self.indices)
    }
}

impl TensorProto {
    fn is_external(&self) -> bool {
        self.data_location != 0 || !self.external_data.is_empty()
    }

    fn location(&self) -> String {
        let location = self
            .external_data
            .iter()
            .find(|entry| entry.key == "location");
        location
            .map(|entry| entry.value.clone())
            .unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write as _;

    fn file(bytes: &[u8]) -> tempfile::NamedTempFile {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        file.write_all(bytes).unwrap();
        file
    }

    fn model(tensor: TensorProto) -> Vec<u8> {
        let constant = AttributeProto {
            t: Some(tensor),
            ..Default::default()
        };
        let node = NodeProto {
            attribute: vec![constant],
        };
        ModelProto {
            graph: Some(Box::new(GraphProto {
                node: vec![node],
                ..Default::default()
            })),
            opset_import: vec![OpsetProto {
                domain: String::new(),
                version: 17,
            }],
            metadata_props: vec![EntryProto {
                key: "family".into(),
                value: "nanodet-plus".into(),
            }],
            functions: vec![],
        }
        .encode_to_vec()
    }

    #[test]
    fn a_whole_file_yields_its_metadata_opsets_and_hash() {
        let file = file(&model(TensorProto::default()));
        let model = read(file.path(), None).unwrap();
        assert_eq!(model.opsets, "ai.onnx 17");
        assert_eq!(model.metadata["family"], "nanodet-plus");
        assert!(read(file.path(), Some(&model.sha256.to_uppercase())).is_ok());
    }

    #[test]
    fn missing_empty_foreign_and_cut_files_are_refused_by_name() {
        let whole = model(TensorProto {
            name: "w".repeat(40),
            ..Default::default()
        });
        let missing = read(Path::new("/nowhere/model.onnx"), None).unwrap_err();
        assert!(missing.to_string().contains("/nowhere/model.onnx"));
        assert!(matches!(
            read(file(&[]).path(), None),
            Err(ModelError::FileSize { bytes: 0, .. })
        ));
        for bytes in [
            b"\x89PNG\r\n\x1a\n picture".as_slice(),
            b"name = \"rig\"",
            &whole[..30],
        ] {
            let error = read(file(bytes).path(), None).unwrap_err();
            assert!(matches!(error, ModelError::NotOnnx { .. }), "{error}");
        }
    }

    #[test]
    fn another_hash_is_refused_with_both() {
        let expected = "0".repeat(64);
        let file = file(&model(TensorProto::default()));
        let message = read(file.path(), Some(&expected)).unwrap_err().to_string();
        assert!(message.contains(&expected) && message.matches(char::is_whitespace).count() > 4);
    }

    #[test]
    fn weights_in_another_file_are_refused_before_anything_opens_it() {
        let location = EntryProto {
            key: "location".into(),
            value: "../../etc/passwd".into(),
        };
        let tensor = TensorProto {
            name: "weights".into(),
            external_data: vec![location],
            data_location: 1,
        };
        let error = read(file(&model(tensor)).path(), None).unwrap_err();
        assert!(error.to_string().contains("../../etc/passwd"), "{error}");
    }

    #[test]
    fn graphs_nested_without_end_are_refused_and_do_not_overflow() {
        let mut graph = GraphProto::default();
        for _ in 0..500 {
            let inner = AttributeProto {
                g: Some(Box::new(graph)),
                ..Default::default()
            };
            let node = NodeProto {
                attribute: vec![inner],
            };
            graph = GraphProto {
                node: vec![node],
                ..Default::default()
            };
        }
        let bytes = ModelProto {
            graph: Some(Box::new(graph)),
            ..Default::default()
        }
        .encode_to_vec();
        assert!(matches!(
            read(file(&bytes).path(), None),
            Err(ModelError::NotOnnx { .. })
        ));
    }
}
