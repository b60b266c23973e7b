//! `ARCHITECTURE.md`: its diagram of members follows from the manifests, and the files and tests that it and the
//! decisions name exist.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

use echolake_testing::run_command;
use serde::Deserialize;

/// The page.
const PAGE: &str = "ARCHITECTURE.md";
/// Folder of the decisions that it links.
const DECISIONS: &str = "docs/decisions";
/// Set to write the diagram.
const RENEW: &str = "ECHOLAKE_RENEW";
/// The lines around the diagram.
const MARKERS: [&str; 2] = ["<!-- members: begin, generated -->\n", "<!-- members: end -->\n"];
/// Members for tests alone, which would clutter the diagram.
const LEFT_OUT: [&str; 2] = ["stress", "testing"];
/// The packages that the program is made of; the project promises to build on them.
const MANDATORY: [&str; 10] = [
    "mcap",
    "arrow",
    "parquet",
    "datafusion",
    "datafusion-distributed",
    "rustfft",
    "serde_json",
    "zstd",
    "clap",
    "axum",
];
/// The root package, which is the command.
const ROOT: &str = "echolake";

/// What `cargo metadata` prints of a workspace.
#[derive(Deserialize)]
struct WorkspaceMetadata {
    packages: Vec<PackageMetadata>,
}

#[derive(Deserialize)]
struct PackageMetadata {
    manifest_path: PathBuf,
    dependencies: Vec<DependencyMetadata>,
}

#[derive(Deserialize)]
struct DependencyMetadata {
    name: String,
    /// None for a normal dependency.
    kind: Option<String>,
    /// Folder of a dependency within the workspace.
    path: Option<PathBuf>,
}

/// Normal dependencies between members, by their folders.
type MemberGraph = BTreeMap<String, BTreeSet<String>>;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn read_page() -> String {
    std::fs::read_to_string(root().join(PAGE)).expect("the page is read")
}

fn decision_names() -> BTreeSet<String> {
    let folder = std::fs::read_dir(root().join(DECISIONS)).expect("the folder is listed");
    folder.map(|entry| entry.expect("an entry").file_name().into_string().expect("text")).collect()
}

/// The page and those of decisions, by their paths.
fn read_pages() -> Vec<(String, String)> {
    let decisions = decision_names().into_iter().map(|name| format!("{DECISIONS}/{name}"));
    let paths = decisions.chain([PAGE.to_owned()]);
    let read = |path: String| (path.clone(), std::fs::read_to_string(root().join(path)).expect("the page is read"));
    paths.map(read).collect()
}

fn member_name(folder: &Path) -> String {
    let name = folder.strip_prefix(root()).expect("a folder of the workspace").display().to_string();
    if name.is_empty() { ROOT.to_owned() } else { name }
}

fn read_packages() -> Vec<PackageMetadata> {
    let mut cargo = Command::new(env!("CARGO"));
    cargo.args(["metadata", "--no-deps", "--format-version", "1", "--offline"]).current_dir(root());
    let output = run_command(&mut cargo).expect("cargo starts");
    assert!(output.status.success(), "{}", super::stderr(&output));
    let metadata: WorkspaceMetadata = serde_json::from_slice(&output.stdout).expect("metadata of a workspace");
    metadata.packages
}

fn read_members() -> MemberGraph {
    let members = read_packages().into_iter().map(|package| {
        let name = member_name(package.manifest_path.parent().expect("a folder"));
        let normal = package.dependencies.into_iter().filter(|dependency| dependency.kind.is_none());
        (name, normal.filter_map(|dependency| dependency.path).map(|path| member_name(&path)).collect())
    });
    members.filter(|(name, _)| !LEFT_OUT.contains(&name.as_str())).collect()
}

fn reaches(graph: &MemberGraph, from: &str, to: &str) -> bool {
    graph.get(from).into_iter().flatten().any(|next| next == to || reaches(graph, next, to))
}

/// The dependencies that do not follow from others: those on a member that no other dependency reaches.
fn reduced(graph: &MemberGraph) -> Vec<(&str, &str)> {
    let edges = graph.iter().flat_map(|(from, all)| all.iter().map(move |to| (from, all, to)));
    let direct = edges.filter(|(_, all, to)| !all.iter().any(|other| reaches(graph, other, to)));
    direct.map(|(from, _, to)| (from.as_str(), to.as_str())).collect()
}

/// A member as Mermaid has it: ids have no slash.
fn node(name: &str) -> String {
    if name.contains('/') { format!("{}[\"{name}\"]", name.replace('/', "_")) } else { name.to_owned() }
}

fn diagram(graph: &MemberGraph) -> String {
    let mut lines: Vec<_> =
        reduced(graph).into_iter().map(|(from, to)| format!("    {} --> {}\n", node(from), node(to))).collect();
    lines.sort();
    format!("```mermaid\ngraph TD\n{}```\n", lines.concat())
}

/// The words in backticks outside of the diagrams, each with the text before it.
fn code_spans(page: &str) -> Vec<(String, String)> {
    let texts: String = page.split("```").step_by(2).collect();
    let parts: Vec<_> = texts.split('`').collect();
    parts.chunks_exact(2).map(|pair| (pair[0].to_owned(), pair[1].to_owned())).collect()
}

#[test]
fn dependencies_that_follow_from_others_are_left_out() {
    let all = [("c", vec!["b", "a/x"]), ("b", vec!["a/x"]), ("a/x", vec![])];
    let named = |names: Vec<&str>| names.into_iter().map(ToOwned::to_owned).collect();
    let graph = all.map(|(name, needs)| (name.to_owned(), named(needs))).into_iter().collect();
    assert_eq!(diagram(&graph), "```mermaid\ngraph TD\n    b --> a_x[\"a/x\"]\n    c --> b\n```\n");
}

#[test]
fn diagram_of_members_is_fresh() {
    let page = read_page();
    let (before, rest) = page.split_once(MARKERS[0]).expect("the first marker");
    let (_, after) = rest.split_once(MARKERS[1]).expect("the second marker");
    let fresh = [before, MARKERS[0], &diagram(&read_members()), MARKERS[1], after].concat();
    if std::env::var_os(RENEW).is_some() {
        std::fs::write(root().join(PAGE), &fresh).expect("the page is written");
    }
    let command = format!("{RENEW}=1 cargo test --profile quick --locked diagram_of_members");
    assert!(read_page() == fresh, "the diagram of {PAGE} is stale; `{command}` renews it");
}

#[test]
fn files_and_tests_that_are_named_exist() {
    let mut missing = Vec::new();
    for (page, text) in read_pages() {
        let mut file = String::new();
        for (before, code) in code_spans(&text) {
            let is_path = code.split_once('/').is_some_and(|(top, _)| !top.is_empty() && root().join(top).is_dir());
            if is_path && !code.contains([' ', '*']) && !root().join(&code).exists() {
                missing.push(format!("{page}: {code}"));
            }
            // A test is named behind its file: `tests/serve.rs`: `it_stops_when_told`.
            if before.trim() == ":" && file.ends_with(".rs") {
                let source = std::fs::read_to_string(root().join(&file)).unwrap_or_default();
                if !source.contains(&format!("fn {code}(")) {
                    missing.push(format!("{page}: {code} in {file}"));
                }
            }
            file = code;
        }
    }
    assert!(missing.is_empty(), "named and not there:\n{}", missing.join("\n"));
}

fn names_crate(folder: &Path, package: &str) -> bool {
    let path = format!("{}::", package.replace('-', "_"));
    super::files_below(folder).into_iter().any(|(name, bytes)| {
        let is_source = name.extension().is_some_and(|extension| extension == "rs");
        is_source
            && String::from_utf8_lossy(&bytes)
                .lines()
                .any(|line| !line.trim().starts_with("//") && line.contains(&path))
    })
}

/// Members whose manifests have a package among their normal dependencies, and that use it in their sources.
fn users_of(package: &str, packages: &[PackageMetadata]) -> Vec<String> {
    let has = |member: &&PackageMetadata| {
        member.dependencies.iter().any(|dependency| dependency.kind.is_none() && dependency.name == package)
    };
    let folders = packages.iter().filter(has).filter_map(|member| member.manifest_path.parent());
    let uses = |folder: &&Path| names_crate(&folder.join("src"), package);
    let users = folders.filter(uses).map(member_name);
    users.filter(|name| !LEFT_OUT.contains(&name.as_str())).collect()
}

#[test]
fn no_mandatory_package_is_lost() {
    let packages = read_packages();
    let lost: Vec<_> = MANDATORY.into_iter().filter(|package| users_of(package, &packages).is_empty()).collect();
    assert!(lost.is_empty(), "no member has them and uses them: {lost:?}");
    assert_eq!(users_of("datafusion-nowhere", &packages), Vec::<String>::new());
}

#[test]
fn every_decision_is_linked() {
    let page = read_page();
    let links = page.split("](docs/decisions/").skip(1);
    let linked: BTreeSet<_> = links.filter_map(|rest| rest.split([')', '#']).next()).map(ToOwned::to_owned).collect();
    assert_eq!(linked, decision_names());
}
