//! Protobuf's editions, which the library of reflection does not know, as the syntax that it knows.
//!
//! An edition has features in the place of a syntax. Of all of them only the presence of fields changes what columns
//! hold: the decoder reads packed and unpacked lists, and both encodings of messages, whatever the descriptor says.

use prost::Message;
use prost_reflect::prost_types::{DescriptorProto, EnumDescriptorProto, FileDescriptorProto, FileDescriptorSet};

/// `edition = "2023"` and `edition = "2024"`, which agree in the presence of fields.
const EDITIONS: [i32; 2] = [1000, 1001];
/// The value of `field_presence` at which a missing value is the type's default.
const IMPLICIT: i32 = 2;

/// The parts of a file descriptor that the library's own lacks.
#[derive(Clone, PartialEq, Message)]
struct EditionFileSet {
    #[prost(message, repeated, tag = "1")]
    file: Vec<EditionFile>,
}

#[derive(Clone, PartialEq, Message)]
struct EditionFile {
    #[prost(message, repeated, tag = "4")]
    message_type: Vec<EditionMessage>,
    #[prost(message, optional, tag = "8")]
    options: Option<EditionFileOptions>,
    #[prost(int32, optional, tag = "14")]
    edition: Option<i32>,
}

#[derive(Clone, PartialEq, Message)]
struct EditionFileOptions {
    #[prost(message, optional, tag = "50")]
    features: Option<FeatureSet>,
}

#[derive(Clone, PartialEq, Message)]
struct EditionMessage {
    #[prost(message, repeated, tag = "2")]
    field: Vec<EditionField>,
    #[prost(message, repeated, tag = "3")]
    nested_type: Vec<EditionMessage>,
    #[prost(message, optional, tag = "7")]
    options: Option<EditionMessageOptions>,
}

#[derive(Clone, PartialEq, Message)]
struct EditionMessageOptions {
    #[prost(message, optional, tag = "12")]
    features: Option<FeatureSet>,
}

#[derive(Clone, PartialEq, Message)]
struct EditionField {
    #[prost(message, optional, tag = "8")]
    options: Option<EditionFieldOptions>,
}

#[derive(Clone, PartialEq, Message)]
struct EditionFieldOptions {
    #[prost(message, optional, tag = "21")]
    features: Option<FeatureSet>,
}

#[derive(Clone, PartialEq, Message)]
struct FeatureSet {
    #[prost(int32, optional, tag = "1")]
    field_presence: Option<i32>,
}

/// Returns `files`, which were decoded from `data`, with those of an edition in the syntax that has their fields'
/// presence. The text of an error names a syntax that is not known.
pub(super) fn without_editions(mut files: FileDescriptorSet, data: &[u8]) -> Result<FileDescriptorSet, String> {
    let editions =
        EditionFileSet::decode(data).map_err(|e| format!("its schema is no set of file descriptors: {e}"))?;
    for (file, edition) in files.file.iter_mut().zip(&editions.file) {
        match file.syntax.as_deref() {
            None | Some("proto2" | "proto3") => {}
            Some("") => file.syntax = None,
            Some("editions") => {
                let number = edition.edition.unwrap_or(0);
                if !EDITIONS.contains(&number) {
                    return Err(format!("its file `{}` is of edition {number}, expected 2023 or 2024", file.name()));
                }
                replace_edition(file, edition);
            }
            Some(other) => {
                return Err(format!("its file `{}` is in `{other}`, expected proto2, proto3 or editions", file.name()));
            }
        }
    }
    Ok(files)
}

// In proto2 all fields know absence; in proto3 those do that say so.
fn replace_edition(file: &mut FileDescriptorProto, edition: &EditionFile) {
    let of_file = presence_of(edition.options.as_ref().and_then(|options| options.features.as_ref()), 0);
    let mut implicit = false;
    for (message, edition) in file.message_type.iter_mut().zip(&edition.message_type) {
        implicit |= mark_presence(message, edition, of_file);
    }
    file.syntax = Some(if implicit { "proto3" } else { "proto2" }.to_owned());
    if implicit {
        file.enum_type.iter_mut().for_each(put_zero_first);
        file.message_type.iter_mut().for_each(put_zeros_first);
    } else {
        file.message_type.iter_mut().for_each(remove_presence);
    }
}

fn presence_of(features: Option<&FeatureSet>, outer: i32) -> i32 {
    features.and_then(|features| features.field_presence).unwrap_or(outer)
}

// Returns whether there is a field that does not know absence.
fn mark_presence(message: &mut DescriptorProto, edition: &EditionMessage, outer: i32) -> bool {
    let of_message = presence_of(edition.options.as_ref().and_then(|options| options.features.as_ref()), outer);
    let mut implicit = false;
    for (field, edition) in message.field.iter_mut().zip(&edition.field) {
        let features = edition.options.as_ref().and_then(|options| options.features.as_ref());
        let is_implicit = presence_of(features, of_message) == IMPLICIT;
        field.proto3_optional = (!is_implicit).then_some(true);
        implicit |= is_implicit;
    }
    for (nested, edition) in message.nested_type.iter_mut().zip(&edition.nested_type) {
        implicit |= mark_presence(nested, edition, of_message);
    }
    implicit
}

fn remove_presence(message: &mut DescriptorProto) {
    message.field.iter_mut().for_each(|field| field.proto3_optional = None);
    message.nested_type.iter_mut().for_each(remove_presence);
}

fn put_zeros_first(message: &mut DescriptorProto) {
    message.enum_type.iter_mut().for_each(put_zero_first);
    message.nested_type.iter_mut().for_each(put_zeros_first);
}

// An enum of proto3 begins with it. The sort keeps the order of names of one number.
fn put_zero_first(names: &mut EnumDescriptorProto) {
    names.value.sort_by_key(|value| value.number() != 0);
}
