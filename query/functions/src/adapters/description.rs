//! Description of a function, in one place for planning, `SHOW FUNCTIONS` and the manual.

use datafusion::logical_expr::{DocSection, Documentation};

/// A function's name, arguments and meaning.
#[derive(Debug)]
pub(crate) struct FunctionDescription {
    pub name: &'static str,
    pub family: FunctionFamily,
    /// Its result, with the unit.
    pub about: &'static str,
    pub parameters: &'static [FunctionParameter],
    /// Number of trailing arguments that are optional.
    pub optional: usize,
    /// A query on a small lake.
    pub example: &'static str,
    /// The answer to the example; a test compares it.
    pub answer: &'static str,
    pub related: &'static [&'static str],
}

/// A chapter of the manual.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum FunctionFamily {
    Levels,
    Responses,
    Comparison,
    Geometry,
    Lists,
    Aggregates,
}

/// One argument.
#[derive(Debug)]
pub(crate) struct FunctionParameter {
    pub name: &'static str,
    pub kind: ArgumentKind,
    /// Its meaning, with the unit.
    pub about: &'static str,
}

/// Kinds of arguments.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ArgumentKind {
    /// A list of numbers, f32 or f64 in the kernel.
    Samples,
    /// A number, f64 in the kernel.
    Number,
    /// A whole number.
    Integer,
    /// Text.
    Text,
    /// True or false.
    Flag,
    /// A value of any type.
    Value,
}

impl FunctionFamily {
    #[cfg(test)]
    pub const ALL: [Self; 6] =
        [Self::Levels, Self::Responses, Self::Comparison, Self::Geometry, Self::Lists, Self::Aggregates];

    /// Returns its heading.
    pub fn title(self) -> &'static str {
        match self {
            Self::Levels => "Levels",
            Self::Responses => "Impulse responses",
            Self::Comparison => "Comparison and diffusion",
            Self::Geometry => "Geometry and symmetry",
            Self::Lists => "Lists",
            Self::Aggregates => "Aggregates",
        }
    }
}

impl ArgumentKind {
    /// Returns a description for errors and the manual.
    pub fn display_words(self) -> &'static str {
        match self {
            Self::Samples => "a list of numbers",
            Self::Number => "a number",
            Self::Integer => "a whole number",
            Self::Text => "text",
            Self::Flag => "a boolean",
            Self::Value => "a value",
        }
    }
}

impl FunctionDescription {
    /// Returns the call syntax, `nce(ir, flat_energy[, centre_hz])`.
    pub fn call_syntax(&self) -> String {
        let required = self.parameters.len() - self.optional;
        let mut text = format!("{}(", self.name);
        for (i, parameter) in self.parameters.iter().enumerate() {
            text += match (i, i < required) {
                (0, true) => "",
                (0, false) => "[",
                (_, true) => ", ",
                (_, false) => "[, ",
            };
            text += parameter.name;
        }
        text + &"]".repeat(self.optional) + ")"
    }

    /// Returns DataFusion's form of the description.
    pub fn build_documentation(&self) -> Documentation {
        let section = DocSection { include: true, label: self.family.title(), description: None };
        let example = format!("```sql\n> {};\n{}\n```", self.example, self.answer);
        let mut built = Documentation::builder(section, self.about, self.call_syntax()).with_sql_example(example);
        for parameter in self.parameters {
            built =
                built.with_argument(parameter.name, format!("{}, {}", parameter.kind.display_words(), parameter.about));
        }
        self.related.iter().fold(built, |built, name| built.with_related_udf(*name)).build()
    }
}
