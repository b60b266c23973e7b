//! A message that FlatBuffers' own compiler made, see `fixtures/reading.fbs`, and what damage does.

use arrow::array::RecordBatch;
use arrow::datatypes::Schema;

use super::*;

const SCHEMA: &[u8] = include_bytes!("fixtures/reading.bfbs");
const MESSAGE: &[u8] = include_bytes!("fixtures/reading.bin");
const NAME: &str = "lab.Reading";

// As JSON, without the columns that are null.
fn decoded(message: &[u8], wanted: Option<&[&str]>) -> Result<String, Malformed> {
    let definition = FlatbufferDefinition::parse(NAME, SCHEMA).expect("a schema");
    let all = definition.fields();
    let is_wanted = |name: &str| wanted.is_none_or(|wanted| wanted.contains(&name));
    let chosen: Vec<_> = (0..all.len()).filter(|i| is_wanted(all[*i].name())).collect();
    let mut decoder = FlatbufferDecoder::new(&definition, &all, &chosen);
    decoder.push(message)?;
    let fields: Fields = chosen.iter().map(|i| all[*i].clone()).collect();
    let columns = decoder.columns().iter_mut().map(|column| column.finish().expect("a column")).collect();
    let batch = RecordBatch::try_new(Arc::new(Schema::new(fields)), columns).expect("a row");
    let mut json = arrow::json::LineDelimitedWriter::new(Vec::new());
    json.write(&batch).expect("JSON");
    json.finish().expect("JSON");
    Ok(String::from_utf8(json.into_inner()).expect("a text").trim().to_owned())
}

#[test]
fn all_kinds_of_member_are_columns() {
    let expected = concat!(
        r#"{"at":"2023-11-14T22:13:20.000000005Z","took":"-PT1.5S","layer":"near","layers":["far","none"],"#,
        r#""flag":false,"small":-7,"count":18446744073709551615,"ratio":0.5,"name":"Größe","tags":["a",""],"#,
        r#""samples":[0.5,-1.5],"data":"0102ff","range":{"low":[1.0,2.0],"at":{"x":3.0,"y":4.0}},"#,
        r#""points":[{"x":1.0,"y":2.0},{"x":3.0,"y":4.0}],"device":{"name":"rig","gain_db":-3.0},"#,
        r#""devices":[{"gain_db":6.0},{"name":"b","gain_db":-3.0}],"#,
        r#""source_type":"Point","source":{"Point":{"x":7.0,"y":8.0}},"empty":[]}"#
    );
    assert_eq!(decoded(MESSAGE, None).expect("a message"), expected);
    let some = decoded(MESSAGE, Some(&["maybe", "name", "ratio"])).expect("a message");
    assert_eq!(some, r#"{"ratio":0.5,"name":"Größe"}"#);
    // A table without any field, behind its list of places.
    let nothing = [8, 0, 0, 0, 4, 0, 4, 0, 4, 0, 0, 0];
    let defaults = r#"{"layer":"near","flag":true,"small":-7,"count":0,"ratio":0.5,"source_type":"NONE"}"#;
    assert_eq!(decoded(&nothing, None).expect("a message"), defaults);
}

#[test]
fn schemas_that_say_less_are_refused() {
    let error = |name, data: &[u8]| FlatbufferDefinition::parse(name, data).expect_err("refused");
    assert!(error("lab.Nothing", SCHEMA).contains("does not describe `lab.Nothing`"));
    assert!(error(NAME, b"lab.Reading").contains("no binary schema of FlatBuffers"));
    assert!(error(NAME, b"").contains("it ends within a value"));
}

// Every byte of schema and message, cut off there and replaced by others: an error or a row, never a panic.
#[test]
fn damage_is_an_error_or_a_row() {
    let (mut failed, mut read) = (0, 0);
    let mut count = |is_ok: bool| if is_ok { read += 1 } else { failed += 1 };
    for at in 0..MESSAGE.len() {
        count(decoded(&MESSAGE[..at], None).is_ok());
        for value in [0, 1, 0x7f, 0x80, 0xff] {
            let mut damaged = MESSAGE.to_vec();
            damaged[at] = value;
            count(decoded(&damaged, None).is_ok());
        }
    }
    for at in 0..SCHEMA.len() {
        count(FlatbufferDefinition::parse(NAME, &SCHEMA[..at]).is_ok());
        for value in [0, 1, 0x7f, 0x80, 0xff] {
            let mut damaged = SCHEMA.to_vec();
            damaged[at] = value;
            let Ok(definition) = FlatbufferDefinition::parse(NAME, &damaged) else {
                count(false);
                continue;
            };
            let all = definition.fields();
            let chosen: Vec<_> = (0..all.len()).collect();
            count(FlatbufferDecoder::new(&definition, &all, &chosen).push(MESSAGE).is_ok());
        }
    }
    assert!(failed > 1000 && read > 1000, "{failed} {read}");
}
