//! `list_tables`, `describe_table`, `list_functions`: what can be asked.

use echolake_query::{SqlFunction, table_meaning};
use echolake_schema::quoted_text;
use echolake_service::RequestFault;
use serde_json::{Value, json};

use super::super::catalogue::ColumnDescription;
use super::tools::ToolCall;

/// Functions of a list.
const MOST_FUNCTIONS: usize = 80;

impl ToolCall<'_> {
    /// The tables and views.
    pub fn list_tables(&self) -> Value {
        let service = self.agents.catalogue.service();
        let views = service.view_definitions();
        let table = |name: &str| {
            let kind = if views.contains_key(name) { "view" } else { "table" };
            json!({ "name": name, "kind": kind, "meaning": table_meaning(name) })
        };
        let tables: Vec<_> = service.all_tables().iter().map(|(name, _)| table(name)).collect();
        let further = "`mcap('RUN')` reads a run's file in place";
        json!({ "tables": tables, "note": further })
    }

    /// A table or view.
    ///
    /// # Errors
    /// [`RequestFault::NotFound`].
    pub fn describe_table(&self, name: &str) -> Result<Value, RequestFault> {
        let service = self.agents.catalogue.service();
        let found = service.all_tables().into_iter().find(|(known, _)| known == name);
        let Some((_, schema)) = found else {
            let hint = "list_tables names all";
            return Err(RequestFault::NotFound { what: format!("table `{}`", quoted_text(name)), hint });
        };
        let columns: Vec<_> = schema.fields().iter().map(|field| ColumnDescription::from_field(field)).collect();
        let mut table = json!({ "name": name, "meaning": table_meaning(name), "columns": columns });
        if let Some(definition) = service.view_definitions().remove(name) {
            table["definition"] = definition.into();
        }
        Ok(table)
    }

    /// The functions; with a text, all that have it in their name or description.
    pub fn list_functions(&self, search: Option<&str>) -> Value {
        let service = self.agents.catalogue.service();
        let wanted = search.unwrap_or_default().to_lowercase();
        let has = |text: &str| text.to_lowercase().contains(&wanted);
        let mut found = service.all_functions();
        found.retain(|f| if search.is_some() { has(&f.name) || has(&f.description) } else { f.is_own });
        // The field's first: they are what an agent cannot know.
        found.sort_by_key(|f| !f.is_own);
        let left_out = found.len().saturating_sub(MOST_FUNCTIONS);
        let function = |f: SqlFunction| {
            let mut function = json!({ "syntax": f.syntax, "description": f.description });
            if let Some(example) = f.example.filter(|_| f.is_own) {
                function["example"] = example.into();
            }
            function
        };
        let functions: Vec<_> = found.into_iter().take(MOST_FUNCTIONS).map(function).collect();
        json!({ "functions": functions, "left_out": left_out })
    }
}
