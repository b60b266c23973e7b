//! Streams of every plain type are read, all others are refused with column, expected and actual type, and no damage
//! of a stream panics or allocates.

use arrow::array::{
    DictionaryArray, Float32Array, Float64Array, Int8Array, Int32Array, Int64Array, LargeStringArray, ListArray,
    NullArray, RunArray, StringArray, StringViewArray, TimestampSecondArray, UInt64Array,
};
use arrow::compute::cast;
use arrow::datatypes::{Float64Type, Int32Type};
use arrow::ipc::writer::{IpcWriteOptions, StreamWriter};
use arrow::ipc::{CompressionType, MetadataVersion};
use echolake_service::FaultCode;

use super::*;

/// Bytes that a row in memory may have per byte that was sent: one bit of a bitmap for a row of doubles.
const MEMORY_PER_BYTE: usize = 16;

fn expected() -> Vec<ExpectedColumn> {
    let column = |(name, content): (&str, _)| ExpectedColumn { name: name.to_owned(), content };
    let columns = [
        ("surface_id", ColumnContent::Name { longest: 64 }),
        ("pair_id", ColumnContent::Integers),
        ("tnce_2500", ColumnContent::Numbers),
        ("tnce_total", ColumnContent::Numbers),
    ];
    columns.map(column).into()
}

fn options() -> IpcWriteOptions {
    IpcWriteOptions::default()
}

fn stream_of(columns: &[(&str, ArrayRef)], options: IpcWriteOptions, batches: usize) -> Bytes {
    let fields = columns.iter().map(|(name, array)| Field::new(*name, array.data_type().clone(), true));
    let schema = Arc::new(Schema::new(fields.collect::<Vec<_>>()));
    let batch = RecordBatch::try_new(schema.clone(), columns.iter().map(|(_, array)| array.clone()).collect());
    let mut writer = StreamWriter::try_new_with_options(Vec::new(), &schema, options).expect("a stream");
    for _ in 0..batches {
        writer.write(batch.as_ref().expect("rows")).expect("written");
    }
    writer.finish().expect("ended");
    writer.into_inner().expect("bytes").into()
}

fn surfaces() -> (&'static str, ArrayRef) {
    ("surface_id", Arc::new(StringArray::from(vec!["flat", "panel_0016_r180_0"])))
}

fn pairs() -> (&'static str, ArrayRef) {
    ("pair_id", Arc::new(Int32Array::from(vec![0, 7])))
}

fn values() -> (&'static str, ArrayRef) {
    ("tnce_2500", Arc::new(Float64Array::from(vec![Some(0.5), None])))
}

fn decoded(body: &Bytes) -> Result<RecordBatch, RequestFault> {
    decode_arrow_body(body, &expected(), 1000)
}

fn refused(body: &Bytes, texts: &[&str]) {
    let fault = decoded(body).expect_err("it is refused");
    assert_eq!(fault.code(), FaultCode::Request, "{fault}");
    for text in texts {
        assert!(fault.to_string().contains(text), "{fault}\nmisses {text}");
    }
}

#[test]
fn plain_types_are_read_as_those_of_the_table() {
    let texts: [ArrayRef; 3] = [
        surfaces().1,
        Arc::new(LargeStringArray::from(vec!["flat", "panel_0016_r180_0"])),
        Arc::new(StringViewArray::from(vec!["flat", "panel_0016_r180_0"])),
    ];
    let numbers: [ArrayRef; 3] =
        [pairs().1, Arc::new(Int8Array::from(vec![0, 7])), Arc::new(UInt64Array::from(vec![0, 7]))];
    let reals: [ArrayRef; 3] = [
        values().1,
        Arc::new(Float32Array::from(vec![Some(0.5), None])),
        cast(&Float32Array::from(vec![Some(0.5), None]), &DataType::Float16).expect("halves"),
    ];
    let once = RecordBatch::try_from_iter_with_nullable([surfaces(), pairs(), values()].map(|(n, a)| (n, a, true)));
    let once = once.expect("rows");
    let twice = concat_batches(once.schema_ref(), [&once, &once]).expect("rows");
    for ((text, number), real) in texts.into_iter().zip(numbers).zip(reals) {
        let body = stream_of(&[("surface_id", text), ("pair_id", number), ("tnce_2500", real)], options(), 2);
        assert_eq!(decoded(&body).expect("plain"), twice);
        // At a place in memory that is aligned for nothing.
        let shifted = Bytes::from([&[0], body.as_ref()].concat()).slice(1..);
        assert_eq!(decoded(&shifted).expect("shifted"), twice);
    }
    let old = IpcWriteOptions::try_new(8, true, MetadataVersion::V4).expect("options");
    assert_eq!(decoded(&stream_of(&[surfaces(), pairs(), values()], old, 2)).expect("old"), twice);
    let none = decoded(&stream_of(&[surfaces(), pairs(), values()], options(), 0)).expect("no rows");
    assert_eq!((none.num_rows(), none.num_columns()), (0, 3));
}

/// E7: the fault names column, expected and actual type.
#[test]
fn a_column_of_another_type_is_refused() {
    let check = |name: &str, array: ArrayRef, texts: &[&str]| {
        let columns = [surfaces(), pairs(), values()];
        let changed = columns.map(|(column, own)| if column == name { (column, array.clone()) } else { (column, own) });
        refused(&stream_of(&changed, options(), 1), &[&[format!("column `{name}`").as_str()], texts].concat());
    };
    check(
        "pair_id",
        Arc::new(Float64Array::from(vec![1.7, 2.0])),
        &["is Float64", "an integer type of 32 bits", "cast(\"int32\")"],
    );
    check("pair_id", Arc::new(TimestampSecondArray::from(vec![0, 1])), &["is Timestamp", "an integer type"]);
    check("pair_id", Arc::new(StringArray::from(vec!["0", "1"])), &["is Utf8", "an integer type"]);
    check("pair_id", Arc::new(Int64Array::from(vec![0, 1 << 40])), &["does not fit", "1099511627776"]);
    check("surface_id", Arc::new(Int32Array::from(vec![1, 2])), &["is Int32", "expected string"]);
    check(
        "surface_id",
        Arc::new(StringArray::from(vec!["flat", &"a".repeat(65)])),
        &["a text of 65 bytes", "64 at most"],
    );
    check("tnce_2500", Arc::new(StringArray::from(vec!["0.5", "1"])), &["is Utf8", "expected double"]);
    let [surface, pair, value] = [surfaces(), pairs(), values()];
    refused(
        &stream_of(&[surface.clone(), pair.clone(), value.clone(), pair.clone()], options(), 1),
        &["column `pair_id` is there twice"],
    );
    let long = "x".repeat(1000);
    let unknown = stream_of(&[surface, pair, (&long, value.1)], options(), 1);
    refused(
        &unknown,
        &[&format!("column `{}...` is not one of predictions", "x".repeat(64)), "surface_id, pair_id, tnce_2500"],
    );
}

/// E3: types that hold more rows than bytes, and bodies that claim a length, are refused before they are decoded.
#[test]
fn what_is_larger_than_its_bytes_is_refused() {
    let ends = Int32Array::from(vec![1, 2]);
    let check = |value: ArrayRef, actual: &str| {
        let body = stream_of(&[surfaces(), pairs(), ("tnce_2500", value)], options(), 1);
        refused(&body, &["column `tnce_2500`", actual, "cast(\"float64\")"]);
    };
    let runs = RunArray::<Int32Type>::try_new(&ends, &Float64Array::from(vec![0.5, 0.25])).expect("runs");
    check(Arc::new(runs), "is RunEndEncoded");
    check(Arc::new(NullArray::new(2)), "is Null");
    check(Arc::new(ListArray::new_null(Arc::new(Field::new("item", DataType::Float64, true)), 2)), "is List");
    let numbers: ArrayRef = Arc::new(Float64Array::from(vec![0.5]));
    let keys = DictionaryArray::<Int32Type>::try_new(Int32Array::from(vec![0, 0]), numbers).expect("a dictionary");
    check(Arc::new(keys), "is dictionary-encoded");
    let named: DictionaryArray<Int32Type> = ["flat", "flat"].into_iter().collect();
    refused(
        &stream_of(&[("surface_id", Arc::new(named))], options(), 1),
        &["is dictionary-encoded", "cast(\"string\")"],
    );
    let compressed = options().try_with_compression(Some(CompressionType::ZSTD)).expect("options");
    let many: ArrayRef = Arc::new(Float64Array::from_value(0.5, 500));
    refused(&stream_of(&[("tnce_2500", many.clone())], compressed, 1), &["is compressed", "hint: write it without"]);
    let fault = decoded(&stream_of(&[("tnce_2500", many)], options(), 3)).expect_err("1500 rows");
    assert_eq!((fault.code(), fault.to_string().contains("more than 1000 rows")), (FaultCode::TooLarge, true));
    // Views of one long text.
    let shared = StringViewArray::from(vec!["a".repeat(60_000); 1]);
    let views: Vec<_> = std::iter::repeat_n(shared.views()[0], 500).collect();
    let views = StringViewArray::try_new(views.into(), shared.data_buffers().to_vec(), None).expect("views");
    refused(&stream_of(&[("surface_id", Arc::new(views))], options(), 1), &["a text of 60000 bytes"]);
}

#[test]
fn what_is_no_whole_stream_is_refused_with_the_way_out() {
    let body = stream_of(&[surfaces(), pairs(), values()], options(), 1);
    refused(&Bytes::new(), &["0 bytes are left, expected 4"]);
    refused(&Bytes::from_static(b"no stream"), &["is no whole Arrow stream", "pyarrow.ipc.new_stream"]);
    refused(&Bytes::from_static(b"ARROW1\0\0"), &["is an Arrow file, expected a stream"]);
    refused(&body.slice(..body.len() - 8), &["has no end", "hint: close its writer"]);
    refused(&Bytes::from([body.as_ref(), body.as_ref()].concat()), &["bytes follow the end"]);
}

/// E6: a damaged stream is refused, and ends no thread.
#[test]
fn no_damage_panics_or_allocates() {
    let texts: ArrayRef = Arc::new(StringViewArray::from(vec!["flat", "panel_0016_r180_0"]));
    let total: ArrayRef = Arc::new(Float32Array::from(vec![0.5, 0.25]));
    for text in [surfaces().1, texts] {
        let body = stream_of(&[("surface_id", text), pairs(), values(), ("tnce_total", total.clone())], options(), 2);
        let mut refusals = 0;
        let mut check = |damaged: Vec<u8>, place: &str| {
            let most = damaged.len() * MEMORY_PER_BYTE;
            match decoded(&damaged.into()) {
                Ok(rows) => assert!(rows.get_array_memory_size() <= most, "{place}: {rows:?}"),
                Err(fault) => {
                    let is_expected = matches!(fault.code(), FaultCode::Request | FaultCode::TooLarge);
                    assert!(is_expected && fault.to_string().len() < 1000, "{place}: {fault}");
                    refusals += 1;
                }
            }
        };
        for bit in 0..body.len() * 8 {
            let mut flipped = body.to_vec();
            flipped[bit / 8] ^= 1 << (bit % 8);
            check(flipped, &format!("bit {bit}"));
        }
        for at in 0..body.len() {
            check(body[..at].to_vec(), &format!("{at} bytes"));
            check([&body[..at], &[0xff; 8][..], &body[at..]].concat(), &format!("8 bytes more at {at}"));
        }
        for at in (0..body.len() - 8).step_by(4) {
            for number in [-1, i64::MAX, i64::MIN, 1 << 62, 1 << 31, (1 << 31) - 1, 1 << 32, 1 << 20, 0] {
                for width in [4, 8] {
                    let mut changed = body.to_vec();
                    changed[at..at + width].copy_from_slice(&number.to_le_bytes()[..width]);
                    check(changed, &format!("{number} at {at}"));
                }
            }
        }
        // Others change values, or bytes that nobody reads.
        assert!(refusals > body.len() * 4, "{refusals}");
    }
}

// The library writes numbers as this reads them.
#[test]
fn values_are_those_that_were_sent() {
    let sent: Vec<f64> = (0..900).map(|i| f64::from(i).sqrt()).collect();
    let rows = decoded(&stream_of(&[("tnce_total", Arc::new(Float64Array::from(sent.clone())))], options(), 1));
    assert_eq!(rows.expect("rows").column(0).as_primitive::<Float64Type>().values(), &sent[..]);
}
