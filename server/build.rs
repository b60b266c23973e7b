//! Embeds the catalogue's pages and the manual: lists their files for `src/door/http/pages.rs`. Pages that come with
//! the sources, as in the archive of a release, are taken as they are. Else npm builds them in a copy below the target
//! folder, which keeps the checkout clean. Without Node the program is built without pages, and says so.
#![allow(clippy::print_stdout, reason = "that is how a build script speaks to cargo")]

use std::env;
use std::ffi::OsStr;
use std::fmt::Write as _;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

/// Sources of the pages, in `web/`.
const SOURCES: [&str; 8] = [
    "src",
    "public",
    "index.html",
    "package.json",
    "package-lock.json",
    "svelte.config.js",
    "tsconfig.json",
    "vite.config.ts",
];
/// Built pages in `web/` of a source archive; a checkout has none.
const PREBUILT: &str = "prebuilt";
/// The Node version that `engines` in `web/package.json` requires.
const NODE: &str = "Node 20.19 (or 22.12) or newer with npm";
/// If one of these is set, a build without pages is an error: its tests would skip the pages.
const STRICT: [&str; 2] = ["ECHOLAKE_NO_SKIP", "CI"];
/// The lock file, and a copy of the one that the installed packages are of: if they differ, npm installs again.
const LOCK: &str = "package-lock.json";
const INSTALLED: &str = "installed.json";
const NPM: &str = if cfg!(windows) { "npm.cmd" } else { "npm" };
/// The folder of the built manual, a full path; `docs/build.sh` builds it. A source archive has it in `docs/`.
const MANUAL: &str = "ECHOLAKE_MANUAL";
const TYPES: [(&str, &str); 9] = [
    ("html", "text/html; charset=utf-8"),
    ("js", "text/javascript; charset=utf-8"),
    ("css", "text/css; charset=utf-8"),
    ("svg", "image/svg+xml"),
    ("jpg", "image/jpeg"),
    ("png", "image/png"),
    ("json", "application/json"),
    ("txt", "text/plain; charset=utf-8"),
    ("woff2", "font/woff2"),
];

fn main() -> ExitCode {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rustc-check-cfg=cfg(pages_not_built)");
    if env::var_os("CARGO_FEATURE_WEB").is_none() {
        return ExitCode::SUCCESS;
    }
    match embed_pages().and_then(|()| embed_manual()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(why) => {
            println!("cargo::error=the catalogue's pages or the manual cannot be built: {why}");
            println!("cargo::error=hint: pages need {NODE}; --no-default-features leaves them out");
            ExitCode::FAILURE
        }
    }
}

fn embed_pages() -> Result<(), String> {
    let web = cargo_variable("CARGO_MANIFEST_DIR")?.join("../web");
    let out = cargo_variable("OUT_DIR")?;
    let prebuilt = web.join(PREBUILT);
    if prebuilt.is_dir() {
        println!("cargo::rerun-if-changed={}", prebuilt.display());
        return write_list(&prebuilt, &out.join("pages.rs"));
    }
    for source in SOURCES {
        println!("cargo::rerun-if-changed={}", web.join(source).display());
    }
    match find_node() {
        Ok(()) => write_list(&build_pages(&web, &out)?, &out.join("pages.rs")),
        Err(why) => leave_out_pages(&why),
    }
}

fn embed_manual() -> Result<(), String> {
    println!("cargo::rerun-if-env-changed={MANUAL}");
    let prebuilt = cargo_variable("CARGO_MANIFEST_DIR")?.join("../docs").join(PREBUILT);
    let list = cargo_variable("OUT_DIR")?.join("manual.rs");
    let built = env::var_os(MANUAL).map(PathBuf::from).or_else(|| prebuilt.is_dir().then_some(prebuilt));
    let Some(manual) = built else { return fs::write(list, "&[]").map_err(|e| e.to_string()) };
    println!("cargo::rerun-if-changed={}", manual.display());
    if !manual.join("index.html").is_file() {
        return Err(format!("{} has no index.html; hint: docs/build.sh {0}", manual.display()));
    }
    write_list(&manual, &list)
}

fn write_list(pages: &Path, to: &Path) -> Result<(), String> {
    let list =
        render_file_list(pages).map_err(|e| format!("the files in {} cannot be listed: {e}", pages.display()))?;
    fs::write(to, list).map_err(|e| e.to_string())
}

/// Returns the folder of the built pages.
fn build_pages(web: &Path, out: &Path) -> Result<PathBuf, String> {
    let copy = out.join("web");
    copy_sources(web, &copy).map_err(|e| format!("their sources cannot be copied to {}: {e}", copy.display()))?;
    let lock = fs::read(copy.join(LOCK)).map_err(|e| format!("there is no {LOCK}: {e}"))?;
    if fs::read(copy.join(INSTALLED)).ok().as_ref() != Some(&lock) {
        run_npm(&copy, &["ci", "--no-audit", "--no-fund"])?;
        fs::write(copy.join(INSTALLED), &lock).map_err(|e| e.to_string())?;
    }
    run_npm(&copy, &["run", "build"])?;
    Ok(copy.join("dist"))
}

/// Checks that npm is there and Node is new enough; the error says what was found.
fn find_node() -> Result<(), String> {
    let version = output_of("node", &["--version"])?;
    let mut numbers =
        version.trim().trim_start_matches('v').split('.').map(|number| number.parse::<u32>().unwrap_or(0));
    let major = numbers.next().unwrap_or(0);
    let minor = numbers.next().unwrap_or(0);
    if !matches!((major, minor), (20, 19..) | (22, 12..) | (23.., _)) {
        return Err(format!("Node is {}", version.trim()));
    }
    output_of(NPM, &["--version"]).map(drop)
}

fn output_of(program: &str, args: &[&str]) -> Result<String, String> {
    let output = Command::new(program).args(args).output().map_err(|e| format!("`{program}` does not start: {e}"))?;
    let failed = || format!("`{program} {}` ended with {}", args.join(" "), output.status);
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).into_owned()).ok_or_else(failed)
}

/// Builds the program without pages; it tells its users how to get them.
fn leave_out_pages(why: &str) -> Result<(), String> {
    for name in STRICT {
        println!("cargo::rerun-if-env-changed={name}");
    }
    if let Some(name) = STRICT.into_iter().find(|name| env::var_os(name).is_some()) {
        return Err(format!("{why}, and ${name} is set"));
    }
    // Once Node is installed, the next build finds it: its folder has changed.
    let folders = env::var_os("PATH").map(|path| env::split_paths(&path).collect::<Vec<_>>()).unwrap_or_default();
    println!("cargo::rerun-if-env-changed=PATH");
    for folder in folders.iter().filter(|folder| folder.is_dir()) {
        println!("cargo::rerun-if-changed={}", folder.display());
    }
    println!("cargo::rustc-cfg=pages_not_built");
    println!("cargo::warning=built without the catalogue's pages: {why}");
    println!("cargo::warning=hint: install {NODE} and build again, or `pip install echolake`");
    Ok(())
}

fn cargo_variable(name: &str) -> Result<PathBuf, String> {
    env::var_os(name).map(PathBuf::from).ok_or_else(|| format!("cargo sets no {name}"))
}

// What is gone from the sources must be gone from the copy too; installed packages stay.
fn copy_sources(web: &Path, copy: &Path) -> io::Result<()> {
    fs::create_dir_all(copy)?;
    for source in SOURCES {
        let to = copy.join(source);
        if to.is_dir() {
            fs::remove_dir_all(&to)?;
        }
        copy_all(&web.join(source), &to)?;
    }
    Ok(())
}

fn copy_all(from: &Path, to: &Path) -> io::Result<()> {
    if !from.is_dir() {
        return fs::copy(from, to).map(|_| ());
    }
    fs::create_dir_all(to)?;
    for entry in fs::read_dir(from)? {
        let entry = entry?;
        copy_all(&entry.path(), &to.join(entry.file_name()))?;
    }
    Ok(())
}

fn run_npm(folder: &Path, args: &[&str]) -> Result<(), String> {
    let output = Command::new(NPM).args(args).current_dir(folder).output().map_err(|e| format!("npm: {e}"))?;
    if output.status.success() {
        return Ok(());
    }
    let said = [output.stderr, output.stdout].map(|bytes| String::from_utf8_lossy(&bytes).trim().replace('\n', " | "));
    Err(format!("`npm {}` ended with {}: {}", args.join(" "), output.status, said.join(" | ")))
}

// An array of what is built; what was packed beside it is named with it.
fn render_file_list(dist: &Path) -> io::Result<String> {
    let mut files = Vec::new();
    collect_files(dist, &mut files)?;
    files.sort();
    let mut list = String::from("&[\n");
    for file in &files {
        let ending = file.extension().and_then(OsStr::to_str).unwrap_or_default();
        let Some((_, media_type)) = TYPES.iter().find(|(known, _)| *known == ending) else { continue };
        let name = file.strip_prefix(dist).map_err(io::Error::other)?.to_string_lossy().replace('\\', "/");
        let packed = |ending: &str| Some(PathBuf::from(format!("{}.{ending}", file.display()))).filter(|p| p.exists());
        let gzip = packed("gz");
        let brotli = packed("br");
        let brotli = brotli.map_or("None".to_owned(), |file| format!("Some(include_bytes!({file:?}))"));
        let _ = writeln!(
            list,
            "PageFile {{ path: {:?}, media_type: {media_type:?}, bytes: include_bytes!({:?}), is_gzip: {}, brotli: \
             {brotli} }},",
            format!("/{name}"),
            gzip.as_ref().unwrap_or(file),
            gzip.is_some(),
        );
    }
    list.push(']');
    Ok(list)
}

fn collect_files(folder: &Path, files: &mut Vec<PathBuf>) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        if path.is_dir() { collect_files(&path, files)? } else { files.push(path) }
    }
    Ok(())
}
