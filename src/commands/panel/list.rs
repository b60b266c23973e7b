//! `echolake panel --list`: the reliefs and their parameters.

use echolake_acquisition::relief::{Domain, Parameter, Relief};

use crate::CommandOutcome;

pub(super) fn run(name: Option<&str>, json: bool) -> anyhow::Result<CommandOutcome> {
    let names: Vec<&str> = name.map_or_else(|| Relief::NAMES.to_vec(), |name| vec![name]);
    let reliefs = names.into_iter().map(Relief::by_name).collect::<Result<Vec<_>, _>>()?;
    let text = if json {
        let each =
            |r: &Relief| serde_json::json!({"relief": r.name(), "typology": r.typology(), "parameters": r.describe()});
        serde_json::to_string_pretty(&reliefs.iter().map(each).collect::<Vec<_>>())?
    } else {
        reliefs.iter().map(described).collect::<Vec<_>>().join("\n\n")
    };
    super::super::print(&text)?;
    Ok(CommandOutcome::Whole)
}

fn described(relief: &Relief) -> String {
    let parameters = relief.describe();
    let lines = parameters.iter().map(line).collect::<String>();
    format!("{} ({}){}", relief.name(), relief.typology(), if lines.is_empty() { ": no parameters" } else { &lines })
}

fn line(parameter: &Parameter) -> String {
    let default = match parameter.domain {
        Domain::Number { default, .. } => default.to_string(),
        Domain::Whole { default, .. } => default.to_string(),
        Domain::Choice { default, .. } => default.to_owned(),
    };
    let Parameter { key, unit, domain, about, .. } = parameter;
    let unit = if unit.is_empty() { String::new() } else { format!(" {unit}") };
    format!("\n  {key} = {default}   {domain}{unit}: {about}")
}
