//! Croissant metadata of a training set (<https://docs.mlcommons.org/croissant/docs/croissant-spec-1.1.html>).

use arrow::datatypes::{DataType, Field};
use echolake_schema::tables::{COMMENT, UNIT};
use serde_json::{Value, json};

use super::card::{CardContents, PAPER};
use super::{SplitPart, heights};
use crate::error::{Error, Result};

const PARQUET: &str = "application/x-parquet";

/// The metadata as JSON-LD.
pub(super) fn croissant_json(about: &CardContents<'_>) -> Result<String> {
    let exported = about.exported;
    let mut distribution: Vec<Value> = Vec::new();
    let mut record_sets = vec![split_record_set()];
    for part in &exported.parts {
        let name = part.part.name();
        let id = format!("measurements-{name}");
        distribution.push(file_set(&id, &format!("data/{name}-*.parquet"), &format!("Measurements of split {name}")));
        record_sets.push(record_set(
            &id,
            &format!("{} rows", part.rows),
            about.plan.schema().fields().iter().map(AsRef::as_ref),
        ));
        if part.height_maps > 0 {
            let id = format!("heightmaps-{name}");
            distribution.push(file_set(
                &id,
                &format!("heightmaps/{name}.parquet"),
                &format!("Height maps of split {name}"),
            ));
            let schema = heights::height_map_schema()?;
            let about = format!("Height maps of {} surfaces", part.height_maps);
            record_sets.push(record_set(&id, &about, schema.fields().iter().map(AsRef::as_ref)));
        }
    }
    distribution.extend(exported.files.iter().map(|file| {
        json!({
            "@type": "cr:FileObject",
            "@id": file.name,
            "name": file.name,
            "contentUrl": file.name,
            "contentSize": format!("{} B", file.bytes),
            "encodingFormat": match file.name.rsplit('.').next() {
                Some("csv") => "text/csv",
                Some("json") => "application/json",
                _ => PARQUET,
            },
            "sha256": file.sha256,
        })
    }));
    let mut document = json!({
        "@context": json_context(),
        "@type": "sc:Dataset",
        "name": "relief-reflections",
        "description": format!(
            "{} Origin: {}. Lake: {}, echolake {}.",
            about.summary(),
            about.origins().join(", "),
            about.version_text().replace('`', ""),
            env!("CARGO_PKG_VERSION"),
        ),
        "conformsTo": "http://mlcommons.org/croissant/1.1",
        // Readers expect three numbers; the second one counts the lake's versions.
        "version": format!("1.{}.0", about.lake_version),
        "citeAs": PAPER,
        "isLiveDataset": false,
        "distribution": distribution,
        "recordSet": record_sets,
    });
    if let Some(license) = &about.plan.set.license {
        document["license"] = json!(license);
    }
    serde_json::to_string_pretty(&document).map(|text| text + "\n").map_err(|e| Error::damaged("croissant.json", e))
}

fn file_set(id: &str, includes: &str, description: &str) -> Value {
    json!({
        "@type": "cr:FileSet",
        "@id": format!("{id}-files"),
        "name": format!("{id}-files"),
        "description": description,
        "encodingFormat": PARQUET,
        "includes": includes,
    })
}

// The names of the splits, to which the field `split` of every row refers.
fn split_record_set() -> Value {
    let data: Vec<_> = SplitPart::ALL
        .iter()
        .map(|part| {
            let role = match part {
                SplitPart::Train => "cr:TrainingSplit",
                SplitPart::Validation => "cr:ValidationSplit",
                SplitPart::Test => "cr:TestSplit",
            };
            json!({ "splits/name": part.name(), "splits/url": role })
        })
        .collect();
    json!({
        "@type": "cr:RecordSet",
        "@id": "splits",
        "name": "splits",
        "dataType": "cr:Split",
        "key": { "@id": "splits/name" },
        "field": [
            { "@type": "cr:Field", "@id": "splits/name", "name": "name", "dataType": "sc:Text" },
            { "@type": "cr:Field", "@id": "splits/url", "name": "url", "dataType": ["sc:URL", "wd:Q3985153"] },
        ],
        "data": data,
    })
}

fn record_set<'a>(id: &str, description: &str, fields: impl Iterator<Item = &'a Field>) -> Value {
    let fields: Vec<_> = fields.map(|f| record_field(id, f)).collect();
    json!({ "@type": "cr:RecordSet", "@id": id, "name": id, "description": description, "field": fields })
}

fn record_field(set: &str, field: &Field) -> Value {
    let of = |key: &str| field.metadata().get(key).filter(|text| !text.is_empty());
    let meaning = of(COMMENT).cloned().unwrap_or_default();
    let description = of(UNIT).map_or_else(|| meaning.clone(), |unit| format!("{meaning} ({unit})"));
    let data_type = match field.data_type() {
        DataType::Utf8 => "sc:Text",
        DataType::Boolean => "sc:Boolean",
        DataType::Int32 | DataType::Int64 => "sc:Integer",
        _ => "cr:Float32",
    };
    let mut value = json!({
        "@type": "cr:Field",
        "@id": format!("{set}/{}", field.name()),
        "name": field.name(),
        "description": description,
        "dataType": data_type,
        "source": { "fileSet": { "@id": format!("{set}-files") }, "extract": { "column": field.name() } },
    });
    if let DataType::FixedSizeList(_, length) = field.data_type() {
        value["isArray"] = true.into();
        value["arrayShape"] = length.to_string().into();
    }
    if field.name() == "split" {
        value["references"] = json!({ "field": { "@id": "splits/name" } });
    }
    value
}

// The context that the specification prescribes.
fn json_context() -> Value {
    json!({
        "@language": "en",
        "@vocab": "https://schema.org/",
        "arrayShape": "cr:arrayShape",
        "citeAs": "cr:citeAs",
        "column": "cr:column",
        "conformsTo": "dct:conformsTo",
        "containedIn": "cr:containedIn",
        "cr": "http://mlcommons.org/croissant/",
        "data": { "@id": "cr:data", "@type": "@json" },
        "dataType": { "@id": "cr:dataType", "@type": "@vocab" },
        "dct": "http://purl.org/dc/terms/",
        "equivalentProperty": "cr:equivalentProperty",
        "examples": { "@id": "cr:examples", "@type": "@json" },
        "extract": "cr:extract",
        "field": "cr:field",
        "fileObject": "cr:fileObject",
        "fileProperty": "cr:fileProperty",
        "fileSet": "cr:fileSet",
        "format": "cr:format",
        "includes": "cr:includes",
        "isArray": "cr:isArray",
        "isLiveDataset": "cr:isLiveDataset",
        "jsonPath": "cr:jsonPath",
        "key": "cr:key",
        "md5": "cr:md5",
        "parentField": "cr:parentField",
        "path": "cr:path",
        "rai": "http://mlcommons.org/croissant/RAI/",
        "recordSet": "cr:recordSet",
        "references": "cr:references",
        "regex": "cr:regex",
        "repeated": "cr:repeated",
        "replace": "cr:replace",
        "samplingRate": "cr:samplingRate",
        "sc": "https://schema.org/",
        "separator": "cr:separator",
        "source": "cr:source",
        "subField": "cr:subField",
        "transform": "cr:transform",
        "wd": "https://www.wikidata.org/wiki/",
    })
}
