//! ROS 2's message definitions as text (`ros2msg`): the types that a schema describes.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::datatypes::{DataType, Field, Fields};
use echolake_schema::tables::LIST_CHILD;

use crate::column::{DEEPEST, MOST_LEAVES, duration_type, time_type};

/// The line between request and response in a service's definition.
const SERVICE_LINE: &str = "---";
/// The ends of the names of a service's message types.
const REQUEST: &str = "_Request";
const RESPONSE: &str = "_Response";
const EVENT: &str = "_Event";
/// Bytes of the id of a service's client in `service_msgs/ServiceEventInfo`.
const CLIENT_BYTES: usize = 16;

/// A message type: its members in their order.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct MessageDefinition {
    pub members: Vec<MessageMember>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct MessageMember {
    name: String,
    pub kind: MemberKind,
    pub count: MemberCount,
}

/// How many values a member has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum MemberCount {
    One,
    Fixed(usize),
    /// The message says it.
    Sequence,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum MemberKind {
    Bool,
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F32,
    F64,
    Text,
    Time,
    Duration,
    Message(MessageDefinition),
}

impl MessageDefinition {
    /// Reads a definition and those it names, which follow it behind lines of `=`. The text of an error says what is
    /// wrong.
    pub fn parse(name: &str, text: &str) -> Result<Self, String> {
        let mut parts = HashMap::new();
        let mut title = name.to_owned();
        let mut lines = Vec::new();
        for line in text.lines().map(str::trim) {
            if line.len() >= 3 && line.bytes().all(|b| b == b'=') {
                add_part(&mut parts, &title, std::mem::take(&mut lines));
            } else if let Some(next) = line.strip_prefix("MSG:").or_else(|| line.strip_prefix("SRV:")) {
                title = next.trim().to_owned();
            } else if !line.split('#').next().unwrap_or("").trim().is_empty() {
                lines.push(line);
            }
        }
        add_part(&mut parts, &title, lines);
        let mut parser = Parser { parts, leaves: 0 };
        match parser.service_of(name) {
            Some(service) => parser.service_event(&service),
            None => parser.parse_definition(&short_name(name), 1),
        }
    }

    /// Returns the columns.
    pub fn column_fields(&self) -> Fields {
        self.members.iter().map(|m| Field::new(&m.name, m.data_type(), false)).collect()
    }
}

/// Both `geometry_msgs/Point` and `geometry_msgs/msg/Point` are meant by either.
fn short_name(name: &str) -> String {
    name.replace("/msg/", "/")
}

// A service's definition is that of its request, a line `---`, and that of its response.
fn add_part<'a>(parts: &mut HashMap<String, Vec<&'a str>>, title: &str, lines: Vec<&'a str>) {
    match lines.iter().position(|line| *line == SERVICE_LINE) {
        Some(at) => {
            parts.entry(format!("{title}{REQUEST}")).or_insert_with(|| lines[..at].to_vec());
            parts.entry(format!("{title}{RESPONSE}")).or_insert_with(|| lines[at + 1..].to_vec());
        }
        // There may be an empty one in front of the first line of `=`.
        None if lines.is_empty() && parts.is_empty() && title.ends_with(EVENT) => {}
        None => drop(parts.entry(short_name(title)).or_insert(lines)),
    }
}

struct Parser<'a> {
    parts: HashMap<String, Vec<&'a str>>,
    leaves: usize,
}

impl Parser<'_> {
    // The service whose events a message type is of, if its schema describes the service and not the events: recorders
    // of ROS 2 store them so.
    fn service_of(&self, name: &str) -> Option<String> {
        let service = name.strip_suffix(EVENT).filter(|service| service.contains("/srv/"))?;
        let is_raw = !self.parts.contains_key(name) && self.parts.contains_key(&format!("{service}{REQUEST}"));
        is_raw.then(|| service.to_owned())
    }

    // Every event has the same first member, and up to one request and one response.
    fn service_event(&mut self, service: &str) -> Result<MessageDefinition, String> {
        let member = |name: &str, kind, count| MessageMember { name: name.to_owned(), kind, count };
        let info = vec![
            member("event_type", MemberKind::U8, MemberCount::One),
            member("stamp", MemberKind::Time, MemberCount::One),
            member("client_gid", MemberKind::U8, MemberCount::Fixed(CLIENT_BYTES)),
            member("sequence_number", MemberKind::I64, MemberCount::One),
        ];
        let info = MessageDefinition { members: info };
        let request = self.parse_definition(&format!("{service}{REQUEST}"), 2)?;
        let response = self.parse_definition(&format!("{service}{RESPONSE}"), 2)?;
        let members = vec![
            member("info", MemberKind::Message(info), MemberCount::One),
            member("request", MemberKind::Message(request), MemberCount::Sequence),
            member("response", MemberKind::Message(response), MemberCount::Sequence),
        ];
        Ok(MessageDefinition { members })
    }

    fn parse_definition(&mut self, name: &str, depth: usize) -> Result<MessageDefinition, String> {
        if depth > DEEPEST {
            return Err(format!("`{name}` stands more than {DEEPEST} messages deep, or within itself"));
        }
        let Some(lines) = self.parts.get(name).cloned() else {
            return Err(format!("its schema does not describe `{name}`"));
        };
        let package = name.split_once('/').map_or("", |(package, _)| package).to_owned();
        let mut members: Vec<MessageMember> = Vec::new();
        for line in lines {
            let Some(member) = self.parse_member(line, &package, depth)? else { continue };
            if members.iter().any(|other| other.name == member.name) {
                return Err(format!("`{name}` has two members `{}`", member.name));
            }
            members.push(member);
        }
        Ok(MessageDefinition { members })
    }

    // None for constants.
    fn parse_member(&mut self, line: &str, package: &str, depth: usize) -> Result<Option<MessageMember>, String> {
        let line = line.split('#').next().unwrap_or("").trim();
        let Some((kind, rest)) = line.split_once(char::is_whitespace) else {
            return Err(format!("`{line}` is no member of a message"));
        };
        self.leaves += 1;
        if self.leaves > MOST_LEAVES {
            return Err(format!("its schema has more than {MOST_LEAVES} columns"));
        }
        let rest = rest.trim_start();
        let end = rest.find(|c: char| c.is_whitespace() || c == '=').unwrap_or(rest.len());
        let (name, behind) = rest.split_at(end);
        if behind.trim_start().starts_with('=') {
            return Ok(None);
        }
        let (kind, count) = parse_count(kind).ok_or_else(|| format!("`{line}` has no length that could be one"))?;
        let kind = self.parse_kind(kind, package, depth)?;
        Ok(Some(MessageMember { name: name.to_owned(), kind, count }))
    }

    fn parse_kind(&mut self, name: &str, package: &str, depth: usize) -> Result<MemberKind, String> {
        let bare = name.split("<=").next().unwrap_or(name);
        Ok(match bare {
            "bool" => MemberKind::Bool,
            "int8" => MemberKind::I8,
            "uint8" | "byte" | "char" => MemberKind::U8,
            "int16" => MemberKind::I16,
            "uint16" => MemberKind::U16,
            "int32" => MemberKind::I32,
            "uint32" => MemberKind::U32,
            "int64" => MemberKind::I64,
            "uint64" => MemberKind::U64,
            "float32" => MemberKind::F32,
            "float64" => MemberKind::F64,
            "string" => MemberKind::Text,
            "wstring" => return Err("how a `wstring` is encoded depends on who wrote it".to_owned()),
            _ => match short_name(bare).as_str() {
                "builtin_interfaces/Time" => MemberKind::Time,
                "builtin_interfaces/Duration" => MemberKind::Duration,
                full if full.contains('/') => MemberKind::Message(self.parse_definition(full, depth + 1)?),
                local => MemberKind::Message(self.parse_definition(&format!("{package}/{local}"), depth + 1)?),
            },
        })
    }
}

// `float64[36]`, `float64[]`, `float64[<=5]`, `string<=10[<=5]`.
fn parse_count(kind: &str) -> Option<(&str, MemberCount)> {
    let Some((base, length)) = kind.strip_suffix(']').and_then(|k| k.rsplit_once('[')) else {
        return Some((kind, MemberCount::One));
    };
    let count = match length {
        "" => MemberCount::Sequence,
        bounded if bounded.starts_with("<=") => MemberCount::Sequence,
        fixed => MemberCount::Fixed(fixed.parse().ok().filter(|n| *n > 0)?),
    };
    Some((base, count))
}

impl MessageMember {
    /// Returns true if it is bytes: an image is no list of numbers.
    pub fn is_binary(&self) -> bool {
        self.count != MemberCount::One && self.kind == MemberKind::U8
    }

    fn data_type(&self) -> DataType {
        let one = self.kind.data_type();
        match self.count {
            MemberCount::One => one,
            _ if self.is_binary() => DataType::Binary,
            _ => DataType::List(Arc::new(Field::new(LIST_CHILD, one, false))),
        }
    }
}

impl MemberKind {
    /// Returns the type of its column.
    pub fn data_type(&self) -> DataType {
        match self {
            Self::Bool => DataType::Boolean,
            Self::I8 => DataType::Int8,
            Self::U8 => DataType::UInt8,
            Self::I16 => DataType::Int16,
            Self::U16 => DataType::UInt16,
            Self::I32 => DataType::Int32,
            Self::U32 => DataType::UInt32,
            Self::I64 => DataType::Int64,
            Self::U64 => DataType::UInt64,
            Self::F32 => DataType::Float32,
            Self::F64 => DataType::Float64,
            Self::Text => DataType::Utf8,
            Self::Time => time_type(),
            Self::Duration => duration_type(),
            Self::Message(definition) if definition.members.is_empty() => DataType::Boolean,
            Self::Message(definition) => DataType::Struct(definition.column_fields()),
        }
    }
}
