//! `echolake panel --list`: the reliefs and their parameters.

use echolake_acquisition::panel::relief::{PanelRelief, ParameterDomain, ReliefParameter};

use crate::CommandOutcome;

pub(super) fn run(name: Option<&str>, json: bool) -> anyhow::Result<CommandOutcome> {
    let names: Vec<&str> = name.map_or_else(|| PanelRelief::NAMES.to_vec(), |name| vec![name]);
    let reliefs = names.into_iter().map(PanelRelief::by_name).collect::<Result<Vec<_>, _>>()?;
    let text = if json {
        serde_json::to_string_pretty(&reliefs.iter().map(json_of).collect::<Vec<_>>())?
    } else {
        reliefs.iter().map(described).collect::<Vec<_>>().join("\n\n")
    };
    super::super::print(&text)?;
    Ok(CommandOutcome::Whole)
}

fn json_of(relief: &PanelRelief) -> serde_json::Value {
    serde_json::json!({
        "relief": relief.name(), "typology": relief.typology(), "parameters": relief.describe(),
    })
}

fn described(relief: &PanelRelief) -> String {
    let parameters = relief.describe();
    let lines = parameters.iter().map(line).collect::<String>();
    format!("{} ({}){}", relief.name(), relief.typology(), if lines.is_empty() { ": no parameters" } else { &lines })
}

fn line(parameter: &ReliefParameter) -> String {
    let default = match parameter.domain {
        ParameterDomain::Number { default, .. } => default.to_string(),
        ParameterDomain::Whole { default, .. } => default.to_string(),
        ParameterDomain::Choice { default, .. } => default.to_owned(),
    };
    let ReliefParameter { key, unit, domain, about, .. } = parameter;
    let unit = if unit.is_empty() { String::new() } else { format!(" {unit}") };
    format!("\n  {key} = {default}   {domain}{unit}: {about}")
}
