//! `echolake panel --list`: the reliefs and their parameters.

use echolake_panel::paper_panel::PaperPanel;
use echolake_panel::relief::{Error, PanelRelief, ParameterDomain, ReliefParameter};

use crate::CommandOutcome;

pub(super) fn list_panels(name: Option<&str>, json: bool) -> anyhow::Result<CommandOutcome> {
    let panels: Vec<_> =
        PaperPanel::ALL.into_iter().filter(|panel| name.is_none_or(|name| name == panel.name)).collect();
    let names: Vec<&str> = name.map_or_else(|| PanelRelief::NAMES.to_vec(), |name| vec![name]);
    let is_relief = |name: &&str| PaperPanel::by_name(name).is_none();
    let reliefs = names.into_iter().filter(is_relief).map(PanelRelief::by_name).collect::<Result<Vec<_>, _>>()?;
    let text = if json {
        let panels = panels.iter().map(json_of_panel).collect::<Result<Vec<_>, _>>()?;
        serde_json::to_string_pretty(&reliefs.iter().map(json_of).chain(panels).collect::<Vec<_>>())?
    } else {
        let panels = panels.iter().map(described_panel);
        reliefs.iter().map(describe_relief).chain(panels).collect::<Vec<_>>().join("\n\n")
    };
    super::super::print_line(&text)?;
    Ok(CommandOutcome::Whole)
}

fn json_of(relief: &PanelRelief) -> serde_json::Value {
    serde_json::json!({
        "relief": relief.name(), "typology": relief.typology(), "parameters": relief.describe_parameters(),
    })
}

fn json_of_panel(panel: &PaperPanel) -> Result<serde_json::Value, Error> {
    let PaperPanel { name, macro_reference, printed, assumed, .. } = panel;
    let mut json = PanelRelief::from_paper(panel)?.to_json();
    json["panel"] = serde_json::json!({
        "name": name, "macro_reference": macro_reference, "printed": printed, "assumed": assumed,
    });
    Ok(json)
}

fn described_panel(panel: &PaperPanel) -> String {
    let PaperPanel { name, relief, settings, macro_reference, printed, assumed } = panel;
    let settings = settings.iter().map(|(key, value)| format!("\n  {key} = {value}")).collect::<String>();
    let reference = macro_reference.map(|name| format!("\n  large shape alone: {name}")).unwrap_or_default();
    format!("{name} (panel of the paper: {relief})\n  printed: {printed}\n  assumed: {assumed}{reference}{settings}")
}

fn describe_relief(relief: &PanelRelief) -> String {
    let parameters = relief.describe_parameters();
    let lines = parameters.iter().map(parameter_line).collect::<String>();
    format!("{} ({}){}", relief.name(), relief.typology(), if lines.is_empty() { ": no parameters" } else { &lines })
}

fn parameter_line(parameter: &ReliefParameter) -> String {
    let default = match parameter.domain {
        ParameterDomain::Number { default, .. } => default.to_string(),
        ParameterDomain::Whole { default, .. } => default.to_string(),
        ParameterDomain::Choice { default, .. } => default.to_owned(),
    };
    let ReliefParameter { key, unit, domain, about, .. } = parameter;
    let unit = if unit.is_empty() { String::new() } else { format!(" {unit}") };
    format!("\n  {key} = {default}   {domain}{unit}: {about}")
}
