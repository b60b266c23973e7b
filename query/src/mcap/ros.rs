//! ROS messages into columns: definitions as text (`ros1msg`, `ros2msg`), values in order, with every length checked. ROS 2
//! writes them in CDR, ROS 1 one behind the other without a header and without alignment.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::datatypes::{DataType, Field, Fields};
use echolake_schema::tables::LIST_CHILD;

use super::column::{Column, DEEPEST, MOST_LEAVES, Record, duration_type, time_type, width};
use super::error::{Malformed, Spent};

const NANOS: i64 = 1_000_000_000;
/// The line between request and response in a service's definition.
const SERVICE_LINE: &str = "---";
/// The ends of the names of a service's message types.
const REQUEST: &str = "_Request";
const RESPONSE: &str = "_Response";
const EVENT: &str = "_Event";
/// Bytes of the id of a service's client in `service_msgs/ServiceEventInfo`.
const CLIENT_BYTES: usize = 16;
/// Longest array of fixed length: it stands in no message, so nothing else bounds it.
const LONGEST: usize = 1 << 20;

/// A version of ROS: the types that its definitions know, and how values are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum RosVersion {
    One,
    Two,
}

/// A message type: its members in their order.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Definition {
    version: RosVersion,
    members: Vec<Member>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
struct Member {
    name: String,
    kind: Kind,
    count: Count,
}

/// How many values a member has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Count {
    One,
    Fixed(usize),
    /// The message says it.
    Sequence,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum Kind {
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
    Message(Definition),
}

impl Definition {
    /// Reads a definition and those it names, which follow it behind lines of `=`. The text of an error says what is
    /// wrong.
    pub(super) fn parse(name: &str, text: &str, version: RosVersion) -> Result<Self, String> {
        let mut parts = HashMap::new();
        let (mut title, mut lines) = (name.to_owned(), Vec::new());
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
        let mut parser = Parser { parts, version, leaves: 0 };
        match parser.service_of(name) {
            Some(service) => parser.service_event(&service),
            None => parser.definition(&short(name), 1),
        }
    }

    /// The columns.
    pub(super) fn fields(&self) -> Result<Fields, String> {
        Ok(self.members.iter().map(|m| Field::new(&m.name, m.data_type(), false)).collect())
    }
}

/// Both `geometry_msgs/Point` and `geometry_msgs/msg/Point` are meant by either.
fn short(name: &str) -> String {
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
        None => drop(parts.entry(short(title)).or_insert(lines)),
    }
}

struct Parser<'a> {
    parts: HashMap<String, Vec<&'a str>>,
    version: RosVersion,
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
    fn service_event(&mut self, service: &str) -> Result<Definition, String> {
        let member = |name: &str, kind, count| Member { name: name.to_owned(), kind, count };
        let info = vec![
            member("event_type", Kind::U8, Count::One),
            member("stamp", Kind::Time, Count::One),
            member("client_gid", Kind::U8, Count::Fixed(CLIENT_BYTES)),
            member("sequence_number", Kind::I64, Count::One),
        ];
        let info = Definition { version: self.version, members: info };
        let request = self.definition(&format!("{service}{REQUEST}"), 2)?;
        let response = self.definition(&format!("{service}{RESPONSE}"), 2)?;
        let members = vec![
            member("info", Kind::Message(info), Count::One),
            member("request", Kind::Message(request), Count::Sequence),
            member("response", Kind::Message(response), Count::Sequence),
        ];
        Ok(Definition { version: self.version, members })
    }

    fn definition(&mut self, name: &str, depth: usize) -> Result<Definition, String> {
        if depth > DEEPEST {
            return Err(format!("`{name}` stands more than {DEEPEST} messages deep, or within itself"));
        }
        let Some(lines) = self.parts.get(name).cloned() else {
            return Err(format!("its schema does not describe `{name}`"));
        };
        let package = name.split_once('/').map_or("", |(package, _)| package).to_owned();
        let mut members: Vec<Member> = Vec::new();
        for line in lines {
            let Some(member) = self.member(line, &package, depth)? else { continue };
            if members.iter().any(|other| other.name == member.name) {
                return Err(format!("`{name}` has two members `{}`", member.name));
            }
            members.push(member);
        }
        Ok(Definition { version: self.version, members })
    }

    // None for constants.
    fn member(&mut self, line: &str, package: &str, depth: usize) -> Result<Option<Member>, String> {
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
        let (kind, count) = count(kind).ok_or_else(|| format!("`{line}` has no length that could be one"))?;
        let kind = self.kind(kind, package, depth)?;
        Ok(Some(Member { name: name.to_owned(), kind, count }))
    }

    fn kind(&mut self, name: &str, package: &str, depth: usize) -> Result<Kind, String> {
        let bare = name.split("<=").next().unwrap_or(name);
        Ok(match bare {
            "byte" if self.version == RosVersion::One => Kind::I8,
            "time" if self.version == RosVersion::One => Kind::Time,
            "duration" if self.version == RosVersion::One => Kind::Duration,
            "Header" if self.version == RosVersion::One => {
                Kind::Message(self.definition("std_msgs/Header", depth + 1)?)
            }
            "bool" => Kind::Bool,
            "int8" => Kind::I8,
            "uint8" | "byte" | "char" => Kind::U8,
            "int16" => Kind::I16,
            "uint16" => Kind::U16,
            "int32" => Kind::I32,
            "uint32" => Kind::U32,
            "int64" => Kind::I64,
            "uint64" => Kind::U64,
            "float32" => Kind::F32,
            "float64" => Kind::F64,
            "string" => Kind::Text,
            "wstring" => return Err("how a `wstring` is encoded depends on who wrote it".to_owned()),
            _ => match short(bare).as_str() {
                "builtin_interfaces/Time" => Kind::Time,
                "builtin_interfaces/Duration" => Kind::Duration,
                full if full.contains('/') => Kind::Message(self.definition(full, depth + 1)?),
                local => Kind::Message(self.definition(&format!("{package}/{local}"), depth + 1)?),
            },
        })
    }
}

// `float64[36]`, `float64[]`, `float64[<=5]`, `string<=10[<=5]`.
fn count(kind: &str) -> Option<(&str, Count)> {
    let Some((base, length)) = kind.strip_suffix(']').and_then(|k| k.rsplit_once('[')) else {
        return Some((kind, Count::One));
    };
    let count = match length {
        "" => Count::Sequence,
        bounded if bounded.starts_with("<=") => Count::Sequence,
        fixed => Count::Fixed(fixed.parse().ok().filter(|n| (1..=LONGEST).contains(n))?),
    };
    Some((base, count))
}

impl Member {
    // Bytes are bytes: an image is no list of numbers.
    fn is_binary(&self) -> bool {
        self.count != Count::One && self.kind == Kind::U8
    }

    fn data_type(&self) -> DataType {
        let one = self.kind.data_type();
        match self.count {
            Count::One => one,
            _ if self.is_binary() => DataType::Binary,
            _ => DataType::List(Arc::new(Field::new(LIST_CHILD, one, false))),
        }
    }
}

impl Kind {
    fn data_type(&self) -> DataType {
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
            Self::Message(definition) => {
                let fields = definition.members.iter().map(|m| Field::new(&m.name, m.data_type(), false));
                DataType::Struct(fields.collect())
            }
        }
    }
}

/// Decodes messages.
pub(super) struct Decoder {
    version: RosVersion,
    members: Vec<(Member, Option<usize>)>,
    record: Record,
    width: usize,
    pub(super) spent: Spent,
}

impl Decoder {
    pub(super) fn new(definition: &Definition, all: &Fields, wanted: &[usize]) -> Self {
        let some: Fields = wanted.iter().map(|i| all[*i].clone()).collect();
        let place = |i: usize| wanted.iter().position(|w| *w == i);
        // What stands behind the last wanted member need not be read.
        let last = wanted.iter().copied().max().map_or(0, |last| last + 1);
        let members = definition.members.iter().take(last).enumerate().map(|(i, m)| (m.clone(), place(i))).collect();
        let width = some.iter().map(|f| width(f.data_type())).sum();
        Self { version: definition.version, members, record: Record::new(&some), width, spent: Spent::default() }
    }

    pub(super) fn push(&mut self, data: &[u8]) -> Result<(), Malformed> {
        self.spent.add(self.width)?;
        let mut cdr = Cdr::new(data, self.version)?;
        for (member, place) in &self.members {
            let column = place.map(|i| &mut self.record.columns[i]);
            member.read(&mut cdr, column, &mut self.spent)?;
        }
        Ok(())
    }

    pub(super) fn columns(&mut self) -> &mut [Column] {
        self.spent = Spent::default();
        &mut self.record.columns
    }
}

impl Member {
    // Reads the member, into a column or past it: CDR has no lengths to jump by.
    fn read(&self, cdr: &mut Cdr<'_>, column: Option<&mut Column>, spent: &mut Spent) -> Result<(), Malformed> {
        let count = match self.count {
            Count::One => return self.kind.read(cdr, column, spent),
            Count::Fixed(count) => count,
            Count::Sequence => cdr.u32()? as usize,
        };
        if self.is_binary() {
            let bytes = cdr.take(count)?;
            if let Some(Column::Binary(c)) = column {
                spent.add(count)?;
                c.push(bytes);
            }
            return Ok(());
        }
        if self.kind.is_without_bytes() {
            spent.add(count)?;
        } else if count > cdr.rest() {
            // Every value takes a byte at least, so a count beyond the rest is a lie.
            return Err(Malformed::Ends);
        }
        match column {
            Some(Column::List(list)) => {
                spent.add(count.saturating_mul(width(&self.kind.data_type())))?;
                if !self.kind.read_many(cdr, count, &mut list.values)? {
                    for _ in 0..count {
                        self.kind.read(cdr, Some(&mut *list.values), spent)?;
                    }
                }
                list.end_row();
            }
            _ => {
                for _ in 0..count {
                    self.kind.read(cdr, None, spent)?;
                }
            }
        }
        Ok(())
    }
}

impl Kind {
    // As messages without members are in ROS 1, and those that have no others.
    fn is_without_bytes(&self) -> bool {
        let Self::Message(definition) = self else { return false };
        let mut members = definition.members.iter();
        match definition.members.is_empty() {
            true => definition.version == RosVersion::One,
            false => members.all(|member| member.count != Count::Sequence && member.kind.is_without_bytes()),
        }
    }

    fn read(&self, cdr: &mut Cdr<'_>, column: Option<&mut Column>, spent: &mut Spent) -> Result<(), Malformed> {
        match self {
            Self::Bool => {
                let value = cdr.array::<1>()?[0] != 0;
                if let Some(Column::Bool(c)) = column {
                    c.push(value);
                }
            }
            Self::I8 => {
                let value = cdr.array::<1>()?[0] as i8;
                if let Some(Column::I8(c)) = column {
                    c.push(value);
                }
            }
            Self::U8 => {
                let [value] = cdr.array::<1>()?;
                if let Some(Column::U8(c)) = column {
                    c.push(value);
                }
            }
            Self::I16 => {
                let value = cdr.u16()? as i16;
                if let Some(Column::I16(c)) = column {
                    c.push(value);
                }
            }
            Self::U16 => {
                let value = cdr.u16()?;
                if let Some(Column::U16(c)) = column {
                    c.push(value);
                }
            }
            Self::I32 => {
                let value = cdr.u32()? as i32;
                if let Some(Column::I32(c)) = column {
                    c.push(value);
                }
            }
            Self::U32 => {
                let value = cdr.u32()?;
                if let Some(Column::U32(c)) = column {
                    c.push(value);
                }
            }
            Self::I64 => {
                let value = cdr.u64()? as i64;
                if let Some(Column::I64(c)) = column {
                    c.push(value);
                }
            }
            Self::U64 => {
                let value = cdr.u64()?;
                if let Some(Column::U64(c)) = column {
                    c.push(value);
                }
            }
            Self::F32 => {
                let value = f32::from_bits(cdr.u32()?);
                if let Some(Column::F32(c)) = column {
                    c.push(value);
                }
            }
            Self::F64 => {
                let value = f64::from_bits(cdr.u64()?);
                if let Some(Column::F64(c)) = column {
                    c.push(value);
                }
            }
            Self::Text => {
                let bytes = cdr.text()?;
                if let Some(Column::Text(c)) = column {
                    spent.add(bytes.len())?;
                    c.push_text(bytes);
                }
            }
            Self::Time | Self::Duration => {
                let (seconds, nanos) = (cdr.u32()?, cdr.u32()?);
                let nanos = match (cdr.version, self) {
                    (RosVersion::One, Self::Time) => i64::from(seconds) * NANOS + i64::from(nanos),
                    (RosVersion::One, _) => i64::from(seconds as i32) * NANOS + i64::from(nanos as i32),
                    (RosVersion::Two, _) => i64::from(seconds as i32) * NANOS + i64::from(nanos),
                };
                match column {
                    Some(Column::Time(c)) => c.push(nanos),
                    Some(Column::Duration(c)) => c.push(nanos),
                    _ => {}
                }
            }
            Self::Message(definition) => return definition.read(cdr, column, spent),
        }
        Ok(())
    }

    // Numbers that stand as they are in memory, all at once; false where they do not.
    fn read_many(&self, cdr: &mut Cdr<'_>, count: usize, column: &mut Column) -> Result<bool, Malformed> {
        if cdr.order == Order::Big || count == 0 {
            return Ok(false);
        }
        match (self, column) {
            (Self::F32, Column::F32(c)) => {
                let bytes = cdr.many::<4>(count)?;
                c.extend(bytes.iter().map(|b| f32::from_le_bytes(*b)));
            }
            (Self::F64, Column::F64(c)) => {
                let bytes = cdr.many::<8>(count)?;
                c.extend(bytes.iter().map(|b| f64::from_le_bytes(*b)));
            }
            _ => return Ok(false),
        }
        Ok(true)
    }
}

impl Definition {
    fn read(&self, cdr: &mut Cdr<'_>, column: Option<&mut Column>, spent: &mut Spent) -> Result<(), Malformed> {
        match column {
            // A message without members has a byte all the same, in ROS 2.
            _ if self.members.is_empty() => {
                if self.version == RosVersion::Two {
                    cdr.array::<1>()?;
                }
                if let Some(Column::Bool(c)) = column {
                    c.push(true);
                }
            }
            Some(Column::Struct(record)) => {
                for (member, column) in self.members.iter().zip(&mut record.columns) {
                    member.read(cdr, Some(column), spent)?;
                }
                record.end_row();
            }
            _ => {
                for member in &self.members {
                    member.read(cdr, None, spent)?;
                }
            }
        }
        Ok(())
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Order {
    Little,
    Big,
}

/// Reads one message's values; each is aligned to its size, counted from behind the header, in ROS 2.
struct Cdr<'a> {
    version: RosVersion,
    data: &'a [u8],
    at: usize,
    order: Order,
    /// The largest alignment: 8 in the first version of CDR, 4 in the second, none (1) in ROS 1.
    align: usize,
}

impl<'a> Cdr<'a> {
    fn new(data: &'a [u8], version: RosVersion) -> Result<Self, Malformed> {
        if version == RosVersion::One {
            return Ok(Self { version, data, at: 0, order: Order::Little, align: 1 });
        }
        let (header, data) = data.split_at_checked(4).ok_or(Malformed::Ends)?;
        let (order, align) = match (header[0], header[1]) {
            (0, 0) => (Order::Big, 8),
            (0, 1) => (Order::Little, 8),
            (0, 6) => (Order::Big, 4),
            (0, 7) => (Order::Little, 4),
            _ => return Err(Malformed::Encapsulation),
        };
        Ok(Self { version, data, at: 0, order, align })
    }

    fn rest(&self) -> usize {
        self.data.len().saturating_sub(self.at)
    }

    fn take(&mut self, count: usize) -> Result<&'a [u8], Malformed> {
        let end = self.at.checked_add(count).ok_or(Malformed::Ends)?;
        let bytes = self.data.get(self.at..end).ok_or(Malformed::Ends)?;
        self.at = end;
        Ok(bytes)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], Malformed> {
        self.at = self.at.next_multiple_of(N.min(self.align));
        let bytes = self.data.get(self.at..).and_then(|rest| rest.first_chunk::<N>()).ok_or(Malformed::Ends)?;
        self.at += N;
        Ok(*bytes)
    }

    fn many<const N: usize>(&mut self, count: usize) -> Result<&'a [[u8; N]], Malformed> {
        self.at = self.at.next_multiple_of(N.min(self.align));
        let bytes = self.take(count.checked_mul(N).ok_or(Malformed::Ends)?)?;
        Ok(bytes.as_chunks::<N>().0)
    }

    fn u16(&mut self) -> Result<u16, Malformed> {
        let bytes = self.array()?;
        Ok(if self.order == Order::Little { u16::from_le_bytes(bytes) } else { u16::from_be_bytes(bytes) })
    }

    fn u32(&mut self) -> Result<u32, Malformed> {
        let bytes = self.array()?;
        Ok(if self.order == Order::Little { u32::from_le_bytes(bytes) } else { u32::from_be_bytes(bytes) })
    }

    fn u64(&mut self) -> Result<u64, Malformed> {
        let bytes = self.array()?;
        Ok(if self.order == Order::Little { u64::from_le_bytes(bytes) } else { u64::from_be_bytes(bytes) })
    }

    // In ROS 2 its length counts a zero at its end, which an empty text may lack.
    fn text(&mut self) -> Result<&'a [u8], Malformed> {
        let length = self.u32()? as usize;
        let bytes = self.take(length)?;
        Ok(match self.version {
            RosVersion::One => bytes,
            RosVersion::Two => bytes.strip_suffix(&[0]).unwrap_or(bytes),
        })
    }
}
