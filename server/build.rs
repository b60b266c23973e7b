//! Builds the catalogue's pages and lists them for `src/http/pages.rs`, so that a build of the program is whole. It works
//! in a copy below the target folder, which keeps the checkout clean, and does nothing where no source of theirs changed.
#![allow(clippy::print_stdout, reason = "that is how a build script speaks to cargo")]

use std::env;
use std::ffi::OsStr;
use std::fmt::Write as _;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

/// What the pages are made of, in `web/`.
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
/// What was installed for; the packages are installed anew where it changes.
const LOCK: &str = "package-lock.json";
const INSTALLED: &str = "installed.json";
const TYPES: [(&str, &str); 8] = [
    ("html", "text/html; charset=utf-8"),
    ("js", "text/javascript; charset=utf-8"),
    ("css", "text/css; charset=utf-8"),
    ("svg", "image/svg+xml"),
    ("png", "image/png"),
    ("json", "application/json"),
    ("txt", "text/plain; charset=utf-8"),
    ("woff2", "font/woff2"),
];

fn main() -> ExitCode {
    println!("cargo::rerun-if-changed=build.rs");
    if env::var_os("CARGO_FEATURE_WEB").is_none() {
        return ExitCode::SUCCESS;
    }
    match pages() {
        Ok(()) => ExitCode::SUCCESS,
        Err(why) => {
            println!("cargo::error=the catalogue's pages cannot be built: {why}");
            println!(
                "cargo::error=hint: they need Node 20.19 or newer with npm; --no-default-features leaves them out"
            );
            ExitCode::FAILURE
        }
    }
}

fn pages() -> Result<(), String> {
    let web = variable("CARGO_MANIFEST_DIR")?.join("../web");
    let out = variable("OUT_DIR")?;
    let copy = out.join("web");
    for source in SOURCES {
        println!("cargo::rerun-if-changed={}", web.join(source).display());
    }
    copy_sources(&web, &copy).map_err(|e| format!("their sources cannot be copied to {}: {e}", copy.display()))?;
    let lock = fs::read(copy.join(LOCK)).map_err(|e| format!("there is no {LOCK}: {e}"))?;
    if fs::read(copy.join(INSTALLED)).ok().as_ref() != Some(&lock) {
        npm(&copy, &["ci", "--no-audit", "--no-fund"])?;
        fs::write(copy.join(INSTALLED), &lock).map_err(|e| e.to_string())?;
    }
    npm(&copy, &["run", "build"])?;
    let list = list(&copy.join("dist")).map_err(|e| format!("what was built cannot be listed: {e}"))?;
    fs::write(out.join("pages.rs"), list).map_err(|e| e.to_string())
}

fn variable(name: &str) -> Result<PathBuf, String> {
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

fn npm(folder: &Path, args: &[&str]) -> Result<(), String> {
    let name = if cfg!(windows) { "npm.cmd" } else { "npm" };
    let output = Command::new(name).args(args).current_dir(folder).output().map_err(|e| format!("npm: {e}"))?;
    if output.status.success() {
        return Ok(());
    }
    let said = [output.stderr, output.stdout].map(|bytes| String::from_utf8_lossy(&bytes).trim().replace('\n', " | "));
    Err(format!("`npm {}` ended with {}: {}", args.join(" "), output.status, said.join(" | ")))
}

// An array of what is built; what was packed beside it is named with it.
fn list(dist: &Path) -> io::Result<String> {
    let mut files = Vec::new();
    find(dist, &mut files)?;
    files.sort();
    let mut list = String::from("&[\n");
    for file in &files {
        let ending = file.extension().and_then(OsStr::to_str).unwrap_or_default();
        let Some((_, media_type)) = TYPES.iter().find(|(known, _)| *known == ending) else { continue };
        let name = file.strip_prefix(dist).map_err(io::Error::other)?.to_string_lossy().replace('\\', "/");
        let packed = |ending: &str| {
            let packed = PathBuf::from(format!("{}.{ending}", file.display()));
            if packed.exists() { format!("Some(include_bytes!({packed:?}))") } else { "None".to_owned() }
        };
        let _ = writeln!(
            list,
            "Page {{ path: {:?}, media_type: {media_type:?}, bytes: include_bytes!({file:?}), gzip: {}, brotli: {} }},",
            format!("/{name}"),
            packed("gz"),
            packed("br")
        );
    }
    list.push(']');
    Ok(list)
}

fn find(folder: &Path, files: &mut Vec<PathBuf>) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        if path.is_dir() { find(&path, files)? } else { files.push(path) }
    }
    Ok(())
}
