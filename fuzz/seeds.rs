//! The files that fuzzing begins with, by the project's own writers.

use std::io::Cursor;
use std::path::{Path, PathBuf};

use echolake_import::import_wav;
use echolake_panel::mesh::{Mesh, MeshFormat};
use echolake_panel::relief::HeightField;
use echolake_schema::messages::SampleFormat;
use echolake_schema::samples::encode_wav;
use hdf5_pure::{AttrValue, FileBuilder};
use ndarray::Array2;
use ndarray_npy::NpzWriter;

use crate::{ImportFolder, LENGTH, POINTS_MM, WAV_MANIFEST, gir_surface, three_points};

/// Frames of recordings; a run of theirs is a few kilobytes.
const FRAMES: usize = 1000;

/// Fills the folder that `ECHOLAKE_SEEDS` names with a folder of files per target, and ends the process; without that
/// variable it does nothing. Every target can do it, so that nothing is built twice, with coverage and without.
///
/// # Panics
/// A file cannot be written.
pub fn write_seeds_on_request() {
    if let Some(folder) = std::env::var_os("ECHOLAKE_SEEDS") {
        write_seeds(PathBuf::from(folder));
        std::process::exit(0);
    }
}

fn write_seeds(folder: PathBuf) {
    let put = |target: &str, name: &str, bytes: &[u8]| {
        let folder = folder.join(target);
        std::fs::create_dir_all(&folder).expect("a folder");
        std::fs::write(folder.join(name), bytes).expect("written");
    };
    for (name, format) in [("16", SampleFormat::S16le), ("24", SampleFormat::S24le), ("f", SampleFormat::F32le)] {
        let bytes = wav(format);
        put("wav", name, &bytes);
        put("mcap", name, &run(&bytes));
    }
    put("rew", "text", rew_text().as_bytes());
    let heights = HeightField::from_fn(585.0, 3, |x, y| (x + y) / 100.0);
    let mesh = Mesh::from_height_field(&heights, -20.0);
    put("stl", "binary", &mesh.to_bytes(MeshFormat::Stl));
    put("stl", "text", TEXT_STL.as_bytes());
    put("glb", "panel", &mesh.to_bytes(MeshFormat::Glb));
    let first = |which: u8, bytes: &[u8]| [&[which], bytes].concat();
    put("gir", "surface", &first(0, &gir_surface()));
    put("gir", "heights", &first(1, &gir_heights()));
    put("gir", "combinations", &first(2, COMBINATIONS.as_bytes()));
    put("gir", "panel_info", &first(3, PANEL_INFO.as_bytes()));
    let scratch = ImportFolder::new();
    for (convention, data_type) in
        [("SingleRoomSRIR", "FIR"), ("SingleRoomMIMOSRIR", "FIR-E"), ("FreeFieldDirectivityTF", "TF")]
    {
        let path = scratch.path().join(convention);
        write_sofa(&path, convention, data_type);
        put("sofa", convention, &std::fs::read(&path).expect("read"));
    }
    let path = scratch.path().join("input.h5");
    write_set(&path);
    put("hdf5", "set", &std::fs::read(&path).expect("read"));
}

const TEXT_STL: &str = "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\n\
                        endfacet\nendsolid a\n";
const COMBINATIONS: &str = "combination,mic_layer,mic_x,mic_y,speaker_layer,speaker_x,speaker_y\n\
                            1,0,0,0,0,1,0\n2,0,0,0,0,2,0\n3,0,1,0,0,2,0\n";
const PANEL_INFO: &str = "panel id,flat reference,foam reference,macrostructure reference,mesostructure reference,sand \
                          type,binder type\na,b,c,flat,river_rock,sand,\n";

// Noise, whose loopback is itself.
fn wav(format: SampleFormat) -> Vec<u8> {
    let width = format.sample_bytes().expect("a width");
    let samples = (0..FRAMES).map(|i| ((i * 7_919) % 20_011) as i32 - 10_005);
    let channel: Vec<u8> = match format {
        SampleFormat::F32le => samples.flat_map(|x| (x as f32 / 40_022.0).to_le_bytes()).collect(),
        _ => samples.flat_map(|x| x.to_le_bytes().into_iter().take(width)).collect(),
    };
    encode_wav(format, 96_000, &[&channel, &channel]).expect("a file")
}

fn rew_text() -> String {
    let samples: String = (0..LENGTH).map(|n| format!("{}\n", if n == 100 { 0.5 } else { 1e-3 })).collect();
    format!(
        "* Impulse Response data saved by REW\n* IR is normalised\n* IR window has not been applied\n\
         0.1 // Peak value before normalisation\n{LENGTH} // Response length\n\
         1.0416666666666666E-5 // Sample interval (seconds)\n-0.0005 // Start time (seconds)\n* Data start\n{samples}"
    )
}

/// Returns the run of a WAV import.
///
/// # Panics
/// It cannot be written.
pub fn run_of_wav() -> Vec<u8> {
    run(&wav(SampleFormat::S16le))
}

// The run of an import.
fn run(wav: &[u8]) -> Vec<u8> {
    let folder = ImportFolder::new();
    folder.write("input.wav", wav);
    let manifest = folder.write("manifest.csv", WAV_MANIFEST.as_bytes());
    let runs = import_wav(&manifest, &three_points(), folder.options(), &mut |_, _| {}).expect("imported");
    std::fs::read(&runs[0].path).expect("read")
}

fn gir_heights() -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    let mut npz = NpzWriter::new(&mut bytes);
    npz.add_array("surface", &Array2::from_shape_fn((4, 4), |(x, y)| (x * y) as f64)).expect("written");
    npz.finish().expect("written");
    bytes.into_inner()
}

fn write_variable(file: &mut FileBuilder, name: &str, shape: &[u64], value: &[f64], attributes: &[(&str, &str)]) {
    let dataset = file.create_dataset(name).with_f64_data(value).with_shape(shape);
    for (key, value) in attributes {
        dataset.set_attr(key, AttrValue::VarLenString((*value).to_owned()));
    }
}

fn write_sofa(path: &Path, convention: &str, data_type: &str) {
    const BINS: u64 = LENGTH as u64 / 2 + 1;
    let mut file = FileBuilder::new();
    let texts =
        [("Conventions", "SOFA"), ("SOFAConventions", convention), ("DataType", data_type), ("APIName", "seeds")];
    for (name, value) in texts {
        file.set_attr(name, AttrValue::VarLenString(value.to_owned()));
    }
    let mut put = |name: &str, shape: &[u64], attributes: &[(&str, &str)], value: &dyn Fn(usize) -> f64| {
        let values: Vec<f64> = (0..shape.iter().product::<u64>() as usize).map(value).collect();
        write_variable(&mut file, name, shape, &values, attributes);
    };
    let metres: &[(&str, &str)] = &[("Type", "cartesian"), ("Units", "metre")];
    match data_type {
        "TF" => {
            put("N", &[BINS], &[("Units", "hertz")], &|k| 96e3 * k as f64 / LENGTH as f64);
            put("Data.Real", &[1, 1, BINS], &[], &|_| 1.0);
            put("Data.Imag", &[1, 1, BINS], &[], &|_| 0.0);
        }
        "FIR-E" => put("Data.IR", &[1, 1, LENGTH as u64, 1], &[], &|n| n as f64 / 1e3),
        _ => put("Data.IR", &[1, 1, LENGTH as u64], &[], &|n| n as f64 / 1e3),
    }
    put("Data.SamplingRate", &[1], &[("Units", "hertz")], &|_| 96e3);
    put("Data.Delay", &[1, 1], &[], &|_| 0.0);
    put("ListenerPosition", &[1, 3], metres, &|i| POINTS_MM[0][i] / 1e3);
    put("ListenerView", &[1, 3], metres, &|i| [1.0, 0.0, 0.0][i]);
    put("ListenerUp", &[1, 3], &[], &|i| [0.0, 0.0, 1.0][i]);
    put("ReceiverPosition", &[1, 3, 1], metres, &|i| [0.15, 0.0, 0.0][i]);
    put("SourcePosition", &[1, 3], &[("Type", "Cartesian"), ("Units", "mm")], &|i| POINTS_MM[2][i]);
    put("EmitterPosition", &[1, 3, 1], &[("Type", "spherical"), ("Units", "degree, degree, metre")], &|_| 0.0);
    put("RoomTemperature", &[1], &[("Units", "kelvin")], &|_| 293.15);
    put("MeasurementDate", &[1], &[], &|_| 1.7e9);
    file.write(path).expect("written");
}

fn write_set(path: &Path) {
    let mut file = FileBuilder::new();
    let responses = file.create_dataset("ir").with_f32_data(&[0.25; 2 * LENGTH]).with_shape(&[1, 2, LENGTH as u64]);
    responses.with_chunks(&[1, 1, 100]).set_attr("fs", AttrValue::F64(96e3));
    let metres: Vec<f64> = POINTS_MM[..2].concat().iter().map(|mm| mm / 1e3).collect();
    write_variable(&mut file, "microphones", &[2, 3], &metres, &[]);
    write_variable(&mut file, "speakers", &[3, 1], &POINTS_MM[2], &[]);
    file.write(path).expect("written");
}
