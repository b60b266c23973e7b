//! Bodies that users add to a lake: Arrow streams of plain types and of those that are refused, and JSON.

use std::sync::Arc;

use arrow::array::{
    Array, ArrayRef, DictionaryArray, Float32Array, Float64Array, Int32Array, Int64Array, LargeStringArray, NullArray,
    RecordBatch, RunArray, StringArray, StringViewArray,
};
use arrow::datatypes::{Field, Int32Type, Schema};
use arrow::ipc::CompressionType;
use arrow::ipc::writer::{IpcWriteOptions, StreamWriter};
use serde_json::json;

const PREDICTIONS: &str = "/api/v1/predictions?model=cnn&version=1";

/// A body that is changed and sent.
pub(super) struct SentBody {
    pub name: &'static str,
    pub path: &'static str,
    pub bytes: Vec<u8>,
}

/// Bodies about a run of surface `flat`.
pub(super) fn bodies(run: &str) -> Vec<SentBody> {
    let texts = || vec!["flat"; 3];
    let names: ArrayRef = Arc::new(StringArray::from(texts()));
    let pairs: ArrayRef = Arc::new(Int32Array::from(vec![0, 1, 2]));
    let values: ArrayRef = Arc::new(Float64Array::from(vec![Some(0.5), None, Some(0.25)]));
    let stream = |name, surface: &ArrayRef, pair: &ArrayRef, value: &ArrayRef, compression| {
        let columns = [("surface_id", surface), ("pair_id", pair), ("tnce_2500", value)];
        let bytes = arrow_stream(&columns, compression);
        SentBody { name, path: PREDICTIONS, bytes }
    };
    let large: ArrayRef = Arc::new(LargeStringArray::from(texts()));
    let views: ArrayRef = Arc::new(StringViewArray::from(vec!["flat", "panel_0016_r180_0", "flat"]));
    let longs: ArrayRef = Arc::new(Int64Array::from(vec![3, 4, 5]));
    let singles: ArrayRef = Arc::new(Float32Array::from(vec![0.5, 0.25, 1.0]));
    let named: ArrayRef = Arc::new(texts().into_iter().collect::<DictionaryArray<Int32Type>>());
    let ends = Int32Array::from(vec![1, 3]);
    let runs = RunArray::<Int32Type>::try_new(&ends, &Float64Array::from(vec![0.5, 0.25])).expect("runs");
    let runs: ArrayRef = Arc::new(runs);
    let nothing: ArrayRef = Arc::new(NullArray::new(3));
    let json = json!({ "annotations": [
        { "annotation_id": "a-1", "run_id": run, "pair_ids": [1, 2], "kind": "label", "value": "odd" },
        { "annotation_id": "a-2", "run_id": run, "microphones": [0], "speakers": [1], "kind": "note", "comment": "x" },
    ] });
    vec![
        stream("a plain stream", &names, &pairs, &values, None),
        stream("wide types", &large, &longs, &singles, None),
        stream("views", &views, &pairs, &singles, None),
        stream("categories", &named, &pairs, &values, None),
        stream("runs of equal values", &names, &pairs, &runs, None),
        stream("no values", &names, &pairs, &nothing, None),
        stream("a compressed stream", &names, &pairs, &values, Some(CompressionType::ZSTD)),
        SentBody { name: "annotations", path: "/api/v1/annotations", bytes: json.to_string().into_bytes() },
    ]
}

fn arrow_stream(columns: &[(&str, &ArrayRef)], compression: Option<CompressionType>) -> Vec<u8> {
    let fields = columns.iter().map(|(name, array)| Field::new(*name, array.data_type().clone(), true));
    let schema = Arc::new(Schema::new(fields.collect::<Vec<_>>()));
    let batch = RecordBatch::try_new(schema.clone(), columns.iter().map(|(_, array)| Arc::clone(array)).collect());
    let options = IpcWriteOptions::default().try_with_compression(compression).expect("options");
    let mut writer = StreamWriter::try_new_with_options(Vec::new(), &schema, options).expect("a stream");
    writer.write(&batch.expect("rows")).expect("written");
    writer.finish().expect("ended");
    writer.into_inner().expect("bytes")
}
