//! Patterns of `to_char`, `to_date` and `to_timestamp`: PostgreSQL's (`YYYY-MM-DD`) as well as those of DataFusion
//! (`%Y-%m-%d`), which takes a pattern without a percent sign for a text.

use std::sync::Arc;

use arrow::array::{AsArray as _, StringArray};
use arrow::compute::cast;
use arrow::datatypes::DataType;
use datafusion::common::ScalarValue;
use datafusion::config::ConfigOptions;
use datafusion::error::{DataFusionError, Result};
use datafusion::functions::datetime::{to_char, to_date, to_timestamp};
use datafusion::logical_expr::{ColumnarValue, Documentation, ScalarFunctionArgs, ScalarUDF, ScalarUDFImpl, Signature};

/// Numbers, whose letters may be small, and what they are in DataFusion; of two that begin alike the longer comes
/// first.
const NUMBERS: [(&str, &str); 15] = [
    ("HH24", "%H"),
    ("HH12", "%I"),
    ("HH", "%I"),
    ("MI", "%M"),
    ("SS", "%S"),
    ("MS", "%3f"),
    ("US", "%6f"),
    ("YYYY", "%Y"),
    ("YY", "%y"),
    ("MM", "%m"),
    ("DDD", "%j"),
    ("DD", "%d"),
    ("IYYY", "%G"),
    ("IW", "%V"),
    ("ID", "%u"),
];
/// Names, whose letters are as they are written. Without `FM` PostgreSQL fills the long ones with spaces.
const NAMES: [(&str, &str); 8] = [
    ("FMMonth", "%B"),
    ("FMDay", "%A"),
    ("Mon", "%b"),
    ("Dy", "%a"),
    ("AM", "%p"),
    ("PM", "%p"),
    ("am", "%P"),
    ("pm", "%P"),
];
/// Parts of a second that are read: any number of digits, with the point before them.
const READ_FRACTIONS: [&str; 2] = [".%3f", ".%6f"];

/// DataFusion's function, with PostgreSQL's patterns, too.
#[derive(Debug, PartialEq, Eq, Hash)]
struct PatternFunction(Arc<ScalarUDF>);

/// Returns the functions for DataFusion.
pub fn pattern_functions(options: &ConfigOptions) -> [ScalarUDF; 3] {
    [to_char(), to_date(), to_timestamp(options)].map(|own| ScalarUDF::new_from_impl(PatternFunction(own)))
}

impl PatternFunction {
    fn translate_argument(&self, pattern: &ColumnarValue) -> Result<ColumnarValue> {
        Ok(match pattern {
            ColumnarValue::Scalar(value) => match value.try_as_str() {
                Some(Some(text)) => ColumnarValue::Scalar(ScalarValue::Utf8(Some(self.translate_pattern(text)?))),
                _ => pattern.clone(),
            },
            ColumnarValue::Array(texts) => {
                let texts = cast(texts, &DataType::Utf8)?;
                let translated =
                    texts.as_string::<i32>().iter().map(|text| text.map(|t| self.translate_pattern(t)).transpose());
                ColumnarValue::Array(Arc::new(translated.collect::<Result<StringArray>>()?))
            }
        })
    }

    fn translate_pattern(&self, pattern: &str) -> Result<String> {
        let translated = chrono_pattern(pattern).map_err(|part| {
            DataFusionError::Execution(format!(
                "{} does not know `{part}` in the pattern `{pattern}`; it knows YYYY, MM, DD, HH24, MI, SS, MS, US and \
                 the like, \"text\", and patterns such as %Y-%m-%d",
                self.name()
            ))
        })?;
        let reads = self.name() != "to_char";
        Ok(READ_FRACTIONS
            .iter()
            .fold(translated, |pattern, part| if reads { pattern.replace(part, "%.f") } else { pattern }))
    }
}

impl ScalarUDFImpl for PatternFunction {
    fn name(&self) -> &str {
        self.0.name()
    }

    fn aliases(&self) -> &[String] {
        self.0.aliases()
    }

    fn signature(&self) -> &Signature {
        self.0.signature()
    }

    fn return_type(&self, types: &[DataType]) -> Result<DataType> {
        self.0.return_type(types)
    }

    fn with_updated_config(&self, options: &ConfigOptions) -> Option<ScalarUDF> {
        let own = self.0.inner().with_updated_config(options)?;
        Some(ScalarUDF::new_from_impl(Self(Arc::new(own))))
    }

    fn invoke_with_args(&self, mut args: ScalarFunctionArgs) -> Result<ColumnarValue> {
        // The pattern of a duration names a style.
        if !matches!(args.args.first().map(ColumnarValue::data_type), Some(DataType::Duration(_))) {
            for pattern in args.args.iter_mut().skip(1) {
                *pattern = self.translate_argument(pattern)?;
            }
        }
        self.0.invoke_with_args(args)
    }

    fn documentation(&self) -> Option<&Documentation> {
        self.0.documentation()
    }
}

/// The pattern for DataFusion; the error is the part of it that is not known.
fn chrono_pattern(pattern: &str) -> std::result::Result<String, String> {
    if pattern.contains('%') {
        return Ok(pattern.to_owned());
    }
    let mut translated = String::with_capacity(pattern.len() + 8);
    let mut rest = pattern;
    while let Some(first) = rest.chars().next() {
        let has_number =
            |(known, _): &&(&str, &str)| rest.get(..known.len()).is_some_and(|start| start.eq_ignore_ascii_case(known));
        let number = NUMBERS.iter().find(has_number);
        if let Some((known, own)) = number.or_else(|| NAMES.iter().find(|(known, _)| rest.starts_with(known))) {
            translated.push_str(own);
            rest = &rest[known.len()..];
        } else if let Some((text, after)) = rest.strip_prefix('"').and_then(|quoted| quoted.split_once('"')) {
            translated.push_str(text);
            rest = after;
        } else if first.is_alphanumeric() || first == '"' {
            return Err(rest.chars().take_while(|c| c.is_alphanumeric()).collect::<String>().trim().to_owned());
        } else {
            translated.push(first);
            rest = &rest[first.len_utf8()..];
        }
    }
    Ok(translated)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patterns_are_translated_or_refused() {
        let known = |pattern: &str| chrono_pattern(pattern).expect(pattern);
        for (pattern, expected) in [
            ("YYYY-MM-DD", "%Y-%m-%d"),
            ("yyyy/mm/dd hh24:mi:ss", "%Y/%m/%d %H:%M:%S"),
            ("YYYYMMDD\"T\"HH24MISS.US", "%Y%m%dT%H%M%S.%6f"),
            ("FMDay, DD Mon YY, HH12:MI AM", "%A, %d %b %y, %I:%M %p"),
            ("%d.%m", "%d.%m"),
            ("--", "--"),
        ] {
            assert_eq!(known(pattern), expected);
        }
        for (pattern, part) in [("YYYY-Q", "Q"), ("Month", "th"), ("at YYYY", "at"), ("999", "999"), ("\"", "")] {
            assert_eq!(chrono_pattern(pattern), Err(part.to_owned()), "{pattern}");
        }
    }
}
