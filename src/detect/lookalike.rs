//! Test models that answer with given numbers: any tensors, written as ONNX by hand.

use prost::Message;

/// A model whose answer does not depend on its input.
#[derive(Clone)]
pub struct Lookalike {
    pub input: Vec<i64>,
    /// ONNX element type of the input: 1 float, 2 uint8.
    pub input_type: i32,
    pub output: Vec<i64>,
    pub answer: Vec<f32>,
    pub metadata: Vec<(&'static str, String)>,
    pub opset: i64,
    pub operator: &'static str,
}

impl Lookalike {
    pub fn nanodet_plus() -> Self {
        Self {
            input: vec![1, 3, 416, 416],
            input_type: 1,
            output: vec![1, 3598, 34],
            answer: vec![0.0; 3598 * 34],
            metadata: vec![
                ("family", "nanodet-plus".to_owned()),
                ("names", r#"{"0": "fire", "1": "smoke"}"#.to_owned()),
            ],
            opset: 17,
            operator: "Identity",
        }
    }

    /// Puts a score and a box of `2 * side` strides into one cell (stride 8, 16, 32, 64 in turn).
    pub fn with_box(mut self, cell: usize, class: usize, score: f32, side: usize) -> Self {
        let row = &mut self.answer[cell * 34..][..34];
        row[class] = score;
        for bins in row[2..].chunks_exact_mut(8) {
            bins[side] = 100.0;
        }
        self
    }

    pub fn write(&self) -> tempfile::NamedTempFile {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), self.model().encode_to_vec()).unwrap();
        file
    }

    fn model(&self) -> Model {
        let node = Node {
            input: vec!["answer".to_owned()],
            output: vec!["output".to_owned()],
            op_type: self.operator.to_owned(),
        };
        let answer = Tensor {
            dims: self.output.clone(),
            data_type: 1,
            name: "answer".to_owned(),
            raw_data: self
                .answer
                .iter()
                .flat_map(|value| value.to_le_bytes())
                .collect(),
        };
        Model {
            ir_version: 8,
            graph: Some(Graph {
                node: vec![node],
                name: "lookalike".to_owned(),
                initializer: vec![answer],
                input: vec![value("data", self.input_type, &self.input)],
                output: vec![value("output", 1, &self.output)],
            }),
            opset_import: vec![Opset {
                version: self.opset,
            }],
            metadata: self
                .metadata
                .iter()
                .map(|(key, value)| Entry {
                    key: (*key).to_owned(),
                    value: value.clone(),
                })
                .collect(),
        }
    }
}

fn value(name: &str, elem_type: i32, dims: &[i64]) -> Value {
    let dim = dims.iter().map(|length| Dim { value: *length }).collect();
    let tensor = TensorType {
        elem_type,
        shape: Some(Shape { dim }),
    };
    Value {
        name: name.to_owned(),
        kind: Some(Kind {
            tensor: Some(tensor),
        }),
    }
}

#[derive(Message)]
struct Model {
    #[prost(int64, tag = "1")]
    ir_version: i64,
    #[prost(message, optional, tag = "7")]
    graph: Option<Graph>,
    #[prost(message, repeated, tag = "8")]
    opset_import: Vec<Opset>,
    #[prost(message, repeated, tag = "14")]
    metadata: Vec<Entry>,
}

#[derive(Message)]
struct Opset {
    #[prost(int64, tag = "2")]
    version: i64,
}

#[derive(Message)]
struct Entry {
    #[prost(string, tag = "1")]
    key: String,
    #[prost(string, tag = "2")]
    value: String,
}

#[derive(Message)]
struct Graph {
    #[prost(message, repeated, tag = "1")]
    node: Vec<Node>,
    #[prost(string, tag = "2")]
    name: String,
    #[prost(message, repeated, tag = "5")]
    initializer: Vec<Tensor>,
    #[prost(message, repeated, tag = "11")]
    input: Vec<Value>,
    #[prost(message, repeated, tag = "12")]
    output: Vec<Value>,
}

#[derive(Message)]
struct Node {
    #[prost(string, repeated, tag = "1")]
    input: Vec<String>,
    #[prost(string, repeated, tag = "2")]
    output: Vec<String>,
    #[prost(string, tag = "4")]
    op_type: String,
}

#[derive(Message)]
struct Tensor {
    #[prost(int64, repeated, tag = "1")]
    dims: Vec<i64>,
    #[prost(int32, tag = "2")]
    data_type: i32,
    #[prost(string, tag = "8")]
    name: String,
    #[prost(bytes = "vec", tag = "9")]
    raw_data: Vec<u8>,
}

#[derive(Message)]
struct Value {
    #[prost(string, tag = "1")]
    name: String,
    #[prost(message, optional, tag = "2")]
    kind: Option<Kind>,
}

#[derive(Message)]
struct Kind {
    #[prost(message, optional, tag = "1")]
    tensor: Option<TensorType>,
}

#[derive(Message)]
struct TensorType {
    #[prost(int32, tag = "1")]
    elem_type: i32,
    #[prost(message, optional, tag = "2")]
    shape: Option<Shape>,
}

#[derive(Message)]
struct Shape {
    #[prost(message, repeated, tag = "1")]
    dim: Vec<Dim>,
}

#[derive(Message)]
struct Dim {
    #[prost(int64, tag = "1")]
    value: i64,
}
