//! The manual's page of functions, `docs/functions.md`, generated from their descriptions.

use std::fmt::Write as _;

use datafusion::logical_expr::Documentation;
use echolake_schema::Rig;

use crate::FunctionSet;
use crate::adapters::description::FunctionFamily;

/// Path of the page; tests run in their package's folder.
const PAGE: &str = "../../docs/functions.md";
/// Set to write the page.
const RENEW: &str = "ECHOLAKE_RENEW";

const HEAD: &str = "# Functions of the field

What `echolake sql` and the query service know beside [DataFusion's own \
functions](https://datafusion.apache.org/user-guide/sql/scalar_functions.html).
Each calls a kernel of `dsp/`. A null argument makes a null answer. Lists may be of any number type and any of Arrow's
list kinds; f32 stays f32 where the answer is a list. A null or NaN inside a list is an error where no answer could be
right. The sampling rate, the bands and the grid are those of the lake's rig; the examples are of the paper's.

For sums, differences and multiples of lists DataFusion has `list_add`, `list_subtract`, `list_scale`, `list_sum`,
`list_avg`, `list_min`, `list_max` and `dot_product`.

This page is generated; `ECHOLAKE_RENEW=1 cargo test --profile quick --workspace manual` writes it.
";

fn manual_page() -> String {
    let functions = FunctionSet::all(&Rig::paper()).expect("the built-in rig is valid");
    let scalar = functions.scalar().iter().filter_map(|f| Some((f.name(), f.documentation()?)));
    let aggregate = functions.aggregate().iter().filter_map(|f| Some((f.name(), f.documentation()?)));
    let all: Vec<_> = scalar.chain(aggregate).collect();
    let mut page = HEAD.to_owned();
    for family in FunctionFamily::ALL {
        let _ = write!(page, "\n## {}\n", family.title());
        for (name, documentation) in all.iter().filter(|(_, d)| d.doc_section.label == family.title()) {
            page += &manual_entry(name, documentation);
        }
    }
    page
}

fn manual_entry(name: &str, documentation: &Documentation) -> String {
    let Documentation { description, syntax_example, sql_example, arguments, related_udfs, .. } = documentation;
    let mut text = format!("\n### {name}\n\n    {syntax_example}\n\n{description}\n\n");
    for (argument, about) in arguments.iter().flatten() {
        let _ = writeln!(text, "- `{argument}`: {about}");
    }
    let _ = writeln!(text, "\n{}", sql_example.as_deref().unwrap_or_default());
    let related: Vec<_> = related_udfs.iter().flatten().map(|name| format!("[{name}](#{name})")).collect();
    if !related.is_empty() {
        let _ = writeln!(text, "\nSee also {}.", related.join(", "));
    }
    text
}

#[test]
fn manual_is_fresh() {
    let page = manual_page();
    if std::env::var_os(RENEW).is_some() {
        std::fs::write(PAGE, &page).expect("the page is written");
    }
    let written = std::fs::read_to_string(PAGE).unwrap_or_default();
    let command = format!("{RENEW}=1 cargo test --profile quick --workspace manual");
    assert!(written == page, "docs/functions.md is stale; `{command}` renews it");
}

#[test]
fn related_functions_exist() {
    let functions = FunctionSet::all(&Rig::paper()).expect("the built-in rig is valid");
    let scalar = functions.scalar().iter().map(|f| (f.name(), f.documentation()));
    let all: Vec<_> = scalar.chain(functions.aggregate().iter().map(|f| (f.name(), f.documentation()))).collect();
    for (name, documentation) in &all {
        let documentation = documentation.unwrap_or_else(|| panic!("{name} says nothing of itself"));
        assert!(documentation.sql_example.is_some() && !documentation.description.is_empty(), "{name}");
        for other in documentation.related_udfs.iter().flatten() {
            assert!(all.iter().any(|(known, _)| known == other), "{name} names {other}");
        }
    }
}
