//! ROS 2 messages that are defined in OMG IDL (`ros2idl`), as the same definitions in ROS 2's own notation. Of IDL it knows what
//! ROS 2 makes of its messages: modules, structs, typedefs, constants, enums and annotations.

use std::collections::{HashMap, HashSet};
use std::fmt::Write as _;

/// Longest chain of typedefs, and deepest nesting of sequences and of modules.
const DEEPEST_TYPE: usize = 16;
/// Longest text that a definition may become.
const MOST_BYTES: usize = 4 << 20;

/// Translates the definitions of a schema: first the members of the message `name`, then those of all others. The text of an
/// error says what is wrong.
pub(super) fn message_definitions(name: &str, text: &str) -> Result<String, String> {
    let tokens = tokens(text)?;
    let mut idl = Idl { tokens: &tokens, ..Idl::default() };
    idl.definitions(&mut Vec::new())?;
    if idl.at < tokens.len() {
        return Err(format!("its schema has a `{}` too many", tokens[idl.at]));
    }
    // The message goes first, without a title.
    let (own, others): (Vec<_>, Vec<_>) = idl.structs.iter().partition(|(path, _)| path == name);
    let (_, members) = own.first().ok_or_else(|| format!("its schema does not describe `{name}`"))?;
    let mut definitions = idl.lines(name, members)?;
    for (path, members) in others {
        let _ = write!(definitions, "===\nMSG: {path}\n{}", idl.lines(path, members)?);
        if definitions.len() > MOST_BYTES {
            return Err(format!("its schema describes more than {} MiB", MOST_BYTES >> 20));
        }
    }
    Ok(definitions)
}

/// A type as it is written.
#[derive(Debug, Clone)]
enum WrittenType<'a> {
    /// By ROS' name.
    Plain(&'static str),
    Sequence(Box<Self>),
    Named(&'a str),
}

#[derive(Debug, Clone)]
struct Declaration<'a> {
    name: &'a str,
    written: WrittenType<'a>,
    /// Length of an array.
    length: Option<&'a str>,
}

#[derive(Default)]
struct Idl<'a> {
    tokens: &'a [&'a str],
    at: usize,
    /// Path, as `std_msgs/msg/Header`, and members.
    structs: Vec<(String, Vec<Declaration<'a>>)>,
    paths: HashSet<String>,
    typedefs: HashMap<String, Declaration<'a>>,
}

impl<'a> Idl<'a> {
    fn definitions(&mut self, scope: &mut Vec<&'a str>) -> Result<(), String> {
        while let Some(token) = self.peek().filter(|token| *token != "}") {
            self.at += 1;
            match token {
                ";" => {}
                "@" => self.annotation()?,
                "module" if scope.len() == DEEPEST_TYPE => {
                    return Err(format!("a module in its schema is more than {DEEPEST_TYPE} deep"));
                }
                "module" => {
                    scope.push(self.next()?);
                    self.expect("{")?;
                    self.definitions(scope)?;
                    self.expect("}")?;
                    scope.pop();
                }
                "struct" => {
                    let path = path(scope, self.next()?);
                    self.expect("{")?;
                    let members = self.members()?;
                    self.paths.insert(path.clone());
                    self.structs.push((path, members));
                }
                "typedef" => {
                    for declaration in self.declarations()? {
                        self.typedefs.insert(path(scope, declaration.name), declaration);
                    }
                }
                "enum" => {
                    let name = self.next()?;
                    let number = Declaration { name, written: WrittenType::Plain("uint32"), length: None };
                    self.typedefs.insert(path(scope, name), number);
                    self.skip_to("}")?;
                }
                "const" => self.skip_to(";")?,
                other => return Err(format!("`{other}` in its schema is no definition that is known here")),
            }
        }
        Ok(())
    }

    fn members(&mut self) -> Result<Vec<Declaration<'a>>, String> {
        let mut members = Vec::new();
        loop {
            match self.peek() {
                Some("}") => {
                    self.at += 1;
                    return Ok(members);
                }
                Some("@") => {
                    self.at += 1;
                    self.annotation()?;
                }
                _ => members.extend(self.declarations()?),
            }
        }
    }

    // `type a, b[3];`
    fn declarations(&mut self) -> Result<Vec<Declaration<'a>>, String> {
        let written = self.written_type(1)?;
        let mut declarations = Vec::new();
        loop {
            let name = self.next()?;
            let mut length = None;
            if self.peek() == Some("[") {
                self.at += 1;
                length = Some(self.next()?);
                self.expect("]")?;
            }
            declarations.push(Declaration { name, written: written.clone(), length });
            match self.next()? {
                "," => {}
                ";" => return Ok(declarations),
                other => return Err(format!("`{name}` in its schema is followed by `{other}`")),
            }
        }
    }

    fn written_type(&mut self, depth: usize) -> Result<WrittenType<'a>, String> {
        if depth > DEEPEST_TYPE {
            return Err(format!("a type in its schema is more than {DEEPEST_TYPE} deep"));
        }
        let first = self.next()?;
        let plain = match first {
            "sequence" => {
                self.expect("<")?;
                let element = self.written_type(depth + 1)?;
                // What bounds its length is no matter to who reads it.
                self.skip_to(">")?;
                return Ok(WrittenType::Sequence(Box::new(element)));
            }
            "string" | "wstring" => {
                if self.peek() == Some("<") {
                    self.skip_to(">")?;
                }
                if first == "string" { "string" } else { "wstring" }
            }
            "unsigned" => match self.next()? {
                "short" => "uint16",
                "long" if self.skip("long") => "uint64",
                "long" => "uint32",
                other => return Err(format!("`unsigned {other}` in its schema is no type")),
            },
            "long" if self.skip("long") => "int64",
            "long" if self.skip("double") => return Err("`long double` has no column".to_owned()),
            "long" | "int32" => "int32",
            "short" | "int16" => "int16",
            "boolean" => "bool",
            "octet" | "char" | "uint8" => "uint8",
            "int8" => "int8",
            "uint16" => "uint16",
            "uint32" => "uint32",
            "int64" => "int64",
            "uint64" => "uint64",
            "float" => "float32",
            "double" => "float64",
            name => return Ok(WrittenType::Named(name)),
        };
        Ok(WrittenType::Plain(plain))
    }

    // `@name` or `@name(...)`, behind its sign.
    fn annotation(&mut self) -> Result<(), String> {
        self.next()?;
        if self.peek() == Some("(") {
            self.skip_to(")")?;
        }
        Ok(())
    }

    fn peek(&self) -> Option<&'a str> {
        self.tokens.get(self.at).copied()
    }

    fn next(&mut self) -> Result<&'a str, String> {
        let token = self.peek().ok_or("its schema ends within a definition")?;
        self.at += 1;
        Ok(token)
    }

    fn skip(&mut self, token: &str) -> bool {
        let is_there = self.peek() == Some(token);
        self.at += usize::from(is_there);
        is_there
    }

    fn skip_to(&mut self, token: &str) -> Result<(), String> {
        while self.next()? != token {}
        Ok(())
    }

    fn expect(&mut self, expected: &str) -> Result<(), String> {
        match self.next()? {
            token if token == expected => Ok(()),
            other => Err(format!("its schema has `{other}` where `{expected}` should be")),
        }
    }

    fn lines(&self, path: &str, members: &[Declaration<'_>]) -> Result<String, String> {
        let scope = path.rsplit_once('/').map_or("", |(scope, _)| scope);
        let mut lines = String::new();
        for member in members {
            let (kind, count) = self.resolve(scope, &member.written, member.length, 1)?;
            let _ = writeln!(lines, "{kind}{count} {}", member.name);
        }
        Ok(lines)
    }

    // ROS' name of a type, and `[]` or `[N]` where it has several values.
    fn resolve(
        &self,
        scope: &str,
        written: &WrittenType<'_>,
        length: Option<&str>,
        depth: usize,
    ) -> Result<(String, String), String> {
        if depth > DEEPEST_TYPE {
            return Err(format!("a type in its schema is more than {DEEPEST_TYPE} deep"));
        }
        let (kind, inner) = match written {
            WrittenType::Plain(name) => ((*name).to_owned(), String::new()),
            WrittenType::Sequence(element) => match self.resolve(scope, element, None, depth + 1)? {
                (kind, count) if count.is_empty() => (kind, "[]".to_owned()),
                _ => return Err("a sequence of sequences or arrays in its schema has no column".to_owned()),
            },
            WrittenType::Named(name) => self.named(scope, name, depth)?,
        };
        match length {
            None => Ok((kind, inner)),
            Some(length) if inner.is_empty() => Ok((kind, format!("[{length}]"))),
            Some(_) => Err("an array of sequences or arrays in its schema has no column".to_owned()),
        }
    }

    // A name is looked for in its own module first, then in those around it.
    fn named(&self, scope: &str, name: &str, depth: usize) -> Result<(String, String), String> {
        let name = name.trim_start_matches("::").replace("::", "/");
        let mut around = Some(scope);
        while let Some(scope) = around {
            let full = if scope.is_empty() { name.clone() } else { format!("{scope}/{name}") };
            if let Some(typedef) = self.typedefs.get(&full) {
                let scope = full.rsplit_once('/').map_or("", |(scope, _)| scope);
                return self.resolve(scope, &typedef.written, typedef.length, depth + 1);
            }
            if self.paths.contains(&full) {
                return Ok((full, String::new()));
            }
            around = (!scope.is_empty()).then(|| scope.rsplit_once('/').map_or("", |(outer, _)| outer));
        }
        // Such as builtin_interfaces/msg/Time; else the message refuses it.
        Ok((name, String::new()))
    }
}

fn path(scope: &[&str], name: &str) -> String {
    scope.iter().chain([&name]).copied().collect::<Vec<_>>().join("/")
}

/// Words, texts and single signs; comments, includes and the lines between files are left out.
fn tokens(text: &str) -> Result<Vec<&str>, String> {
    let mut tokens = Vec::new();
    let mut rest = text.trim_start();
    let mut is_line_start = true;
    while let Some(first) = rest.chars().next() {
        let is_between = rest.starts_with("===") || rest.starts_with("IDL:") || first == '#';
        let length = if rest.starts_with("//") || (is_line_start && is_between) {
            rest.find('\n').unwrap_or(rest.len())
        } else if let Some(comment) = rest.strip_prefix("/*") {
            comment.find("*/").ok_or("a comment in its schema does not end")? + 4
        } else if first == '"' {
            text_length(rest).ok_or("a text in its schema does not end")?
        } else {
            let is_word = |c: char| c.is_alphanumeric() || matches!(c, '_' | ':' | '.' | '+' | '-');
            let length = rest.find(|c| !is_word(c)).unwrap_or(rest.len()).max(first.len_utf8());
            tokens.push(&rest[..length]);
            length
        };
        let behind = &rest[length..];
        rest = behind.trim_start();
        is_line_start = behind[..behind.len() - rest.len()].contains('\n');
    }
    Ok(tokens)
}

// Bytes of a text in quotes, with backslashes before quotes in it.
fn text_length(quoted: &str) -> Option<usize> {
    let mut is_escaped = false;
    quoted.char_indices().skip(1).find_map(|(at, c)| {
        let ends = c == '"' && !is_escaped;
        is_escaped = c == '\\' && !is_escaped;
        ends.then_some(at + 1)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const IMU: &str = r#"
        // generated
        #include "std_msgs/msg/Header.idl"
        module lab_msgs {
          module msg {
            typedef double double__9[9];
            module Imu_Constants { const uint8 FAST = 2; const string WHY = "a; \"b\""; };
            enum Layer { near, far };
            @verbatim (language="comment", text="one " "reading; of (a)" "rig")
            struct Imu {
              std_msgs::msg::Header header;
              @default (value=1.5) @unit("m/s")
              float speed;
              double__9 covariance; /* row by row */
              sequence<Point, 5> points;
              string<10> name, other;
              sequence<octet> data;
              unsigned long long count;
              long low[3];
              Layer layer;
            };
            struct Point { double x; };
          };
        };
        ================================================================================
        IDL: std_msgs/msg/Header
        module std_msgs { module msg { struct Header { builtin_interfaces::msg::Time stamp; string frame_id; }; }; };
    "#;

    #[test]
    fn idl_becomes_definitions_of_ros() {
        let expected = "std_msgs/msg/Header header\nfloat32 speed\nfloat64[9] covariance\nlab_msgs/msg/Point[] points\n\
                        string name\nstring other\nuint8[] data\nuint64 count\nint32[3] low\nuint32 layer\n\
                        ===\nMSG: lab_msgs/msg/Point\nfloat64 x\n\
                        ===\nMSG: std_msgs/msg/Header\nbuiltin_interfaces/msg/Time stamp\nstring frame_id\n";
        assert_eq!(message_definitions("lab_msgs/msg/Imu", IMU).expect("definitions"), expected);
    }

    #[test]
    fn what_has_no_column_is_refused_in_words() {
        for (idl, expected) in [
            ("module a { struct B { long double x; }; };", "long double"),
            ("module a { struct B { sequence<sequence<long>> x; }; };", "sequence of sequences"),
            ("module a { union B switch(long) { case 1: long x; }; };", "`union`"),
            ("module a { typedef C D; typedef D C; struct B { C x; }; };", "16 deep"),
            ("module a { struct B { long x; };", "ends within"),
            ("module a { }; }", "too many"),
            ("module a { struct C { long x; }; };", "does not describe `a/B`"),
            ("/* never", "does not end"),
            ("\"never", "does not end"),
        ] {
            let error = message_definitions("a/B", idl).expect_err(idl);
            assert!(error.contains(expected), "{idl}: {error}");
        }
    }

    #[test]
    fn cut_off_schemas_do_not_end_a_scan() {
        for end in (0..IMU.len()).filter(|end| IMU.is_char_boundary(*end)) {
            let _ = message_definitions("lab_msgs/msg/Imu", &IMU[..end]);
        }
        let deep = "module a {".repeat(100_000);
        assert!(message_definitions("a/B", &deep).expect_err("refused").contains("16 deep"));
    }
}
