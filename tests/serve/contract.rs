//! Answers against `web/openapi.json`: as much of JSON Schema as the document uses.

use serde_json::Value;

/// The document that server and pages agree on.
pub(super) struct ApiContract(Value);

impl ApiContract {
    pub fn read() -> Self {
        Self(serde_json::from_str(include_str!("../../web/openapi.json")).expect("JSON"))
    }

    /// Its paths that are asked by GET.
    pub fn gets(&self) -> impl Iterator<Item = &str> {
        let paths = self.0["paths"].as_object().expect("paths");
        paths.iter().filter(|(_, methods)| methods.get("get").is_some()).map(|(path, _)| path.as_str())
    }

    /// Returns the defects of an answer to GET.
    pub fn objections(&self, path: &str, status: u16, media_type: &str, body: &[u8]) -> Vec<String> {
        let responses = &self.0["paths"][path]["get"]["responses"];
        let own = responses.get(status.to_string());
        let response = self.resolved(own.unwrap_or(&responses["default"]));
        let bare = media_type.split(';').next().unwrap_or_default();
        let Some(content) = response["content"].get(bare) else {
            return vec![format!("{status} comes as `{media_type}`, which the contract does not know")];
        };
        let mut found = Vec::new();
        if bare.ends_with("json") {
            match serde_json::from_slice(body) {
                Ok(value) => self.check(&content["schema"], &value, "", &mut found),
                Err(e) => found.push(format!("it is no JSON: {e}")),
            }
        }
        found
    }

    fn resolved<'a>(&'a self, schema: &'a Value) -> &'a Value {
        match schema["$ref"].as_str() {
            Some(place) => self.0.pointer(place.trim_start_matches('#')).expect("a place in the document"),
            None => schema,
        }
    }

    fn check(&self, schema: &Value, value: &Value, at: &str, found: &mut Vec<String>) {
        let schema = self.resolved(schema);
        if let Some(any) = schema["anyOf"].as_array().or(schema["oneOf"].as_array()) {
            let fits = any.iter().any(|one| {
                let mut wrong = Vec::new();
                self.check(one, value, at, &mut wrong);
                wrong.is_empty()
            });
            if !fits {
                found.push(format!("{at}: {value} is none of {any:?}"));
            }
            return;
        }
        if !is_of_type(&schema["type"], value) {
            found.push(format!("{at}: {value} is no {}", schema["type"]));
            return;
        }
        if let Some(known) = schema["enum"].as_array()
            && !known.contains(value)
        {
            found.push(format!("{at}: {value} is none of {known:?}"));
        }
        if let Some(least) = schema["minimum"].as_f64()
            && value.as_f64().is_some_and(|v| v < least)
        {
            found.push(format!("{at}: {value} is below {least}"));
        }
        for (i, item) in value.as_array().into_iter().flatten().enumerate() {
            self.check(&schema["items"], item, &format!("{at}/{i}"), found);
        }
        self.check_properties(schema, value, at, found);
    }

    fn check_properties(&self, schema: &Value, value: &Value, at: &str, found: &mut Vec<String>) {
        let Some(object) = value.as_object() else { return };
        for required in schema["required"].as_array().into_iter().flatten().filter_map(Value::as_str) {
            if !object.contains_key(required) {
                found.push(format!("{at}: `{required}` is missing"));
            }
        }
        for (name, value) in object {
            match schema["properties"].get(name) {
                Some(property) => self.check(property, value, &format!("{at}/{name}"), found),
                None if schema["additionalProperties"] == Value::Bool(false) => {
                    found.push(format!("{at}: `{name}` is not in the contract"));
                }
                None => {}
            }
        }
    }
}

fn is_of_type(wanted: &Value, value: &Value) -> bool {
    let one = |name: &Value| match name.as_str() {
        Some("null") => value.is_null(),
        Some("string") => value.is_string(),
        Some("boolean") => value.is_boolean(),
        Some("integer") => value.is_i64() || value.is_u64(),
        Some("number") => value.is_number(),
        Some("array") => value.is_array(),
        Some("object") => value.is_object(),
        _ => false,
    };
    match wanted {
        Value::Array(several) => several.iter().any(one),
        Value::String(_) => one(wanted),
        _ => true,
    }
}
