//! A surface's responses as SOFA (AES69-2022), convention SingleRoomSRIR 1.0: one measurement per pair, the microphone
//! as listener and the speaker as source, in metres over the panel.

use std::path::Path;

use echolake_lake::Lake;
use echolake_schema::{Point, Timestamp};
use rust_hdf5::{H5Dataset, H5File, Hdf5Error};
use sha2::{Digest as _, Sha256};

use super::SurfaceResponses;
use crate::error::{Error, Result};
use crate::output::{PendingFolder, WrittenFile};

/// Label that netCDF gives a dimension without coordinates; the size follows it.
const NO_VARIABLE: &str = "This is a netCDF dimension but not a netCDF variable.";
const KELVIN: f64 = 273.15;

/// The dimensions of a file, by SOFA's letters.
struct Dimensions(Vec<(char, usize, H5Dataset)>);

/// Writes `<surface>.sofa`.
pub(super) fn write_sofa(lake: &Lake, responses: &SurfaceResponses, folder: &PendingFolder) -> Result<WrittenFile> {
    let name = format!("{}.sofa", responses.run.surface);
    let path = folder.partial_path(&name);
    create_sofa(&path, lake, responses).map_err(|e| Error::write(&folder.final_path(&name), e))?;
    let bytes = std::fs::read(&path).map_err(|e| Error::write(&folder.final_path(&name), e))?;
    Ok(WrittenFile { name, bytes: bytes.len() as u64, sha256: hex::encode(Sha256::digest(&bytes)) })
}

/// Creates a file at `path`.
pub(super) fn create_sofa(
    path: &Path,
    lake: &Lake,
    responses: &SurfaceResponses,
) -> std::result::Result<(), Hdf5Error> {
    let file = H5File::options().track_order(true).track_times(false).create(path)?;
    fill_sofa(&file, lake, responses)?;
    file.close()
}

fn fill_sofa(file: &H5File, lake: &Lake, responses: &SurfaceResponses) -> std::result::Result<(), Hdf5Error> {
    let rig = lake.rig();
    let reference = rig.impulse_response.reference_temperature_c.get();
    let first = Timestamp(responses.log_time_ns.iter().copied().min().unwrap_or(0)).to_string();
    let date = first.replace('T', " ").chars().take(19).collect::<String>();
    let comment = format!(
        "Surface {}, run {}. Responses over the loopback, on the time axis of {reference} C, direct sound still in \
         them.",
        responses.run.surface, responses.run.run
    );
    for (name, value) in [
        ("Conventions", "SOFA"),
        ("Version", "2.1"),
        ("SOFAConventions", "SingleRoomSRIR"),
        ("SOFAConventionsVersion", "1.0"),
        ("APIName", "echolake"),
        ("APIVersion", env!("CARGO_PKG_VERSION")),
        ("ApplicationName", "echolake"),
        ("ApplicationVersion", env!("CARGO_PKG_VERSION")),
        ("AuthorContact", ""),
        ("Comment", &comment),
        ("DataType", "FIR"),
        ("DatabaseName", &rig.name),
        ("DateCreated", &date),
        ("DateModified", &date),
        ("License", "No license provided, ask the author for permission"),
        ("ListenerDescription", "Microphone, taken for omnidirectional"),
        ("Organization", ""),
        ("RoomType", "free field"),
        ("RoomDescription", "A relief panel, its centre at the origin, z up from its surface"),
        ("SourceDescription", "Speaker, taken for omnidirectional"),
        ("Title", responses.run.surface.as_str()),
    ] {
        file.set_attr_string(name, value)?;
    }
    let pairs = responses.pairs.len();
    let dimensions = Dimensions::create_scales(
        file,
        &[('M', pairs), ('R', 1), ('E', 1), ('N', responses.length), ('C', 3), ('I', 1)],
    )?;
    let cartesian: &[(&str, &str)] = &[("Type", "cartesian"), ("Units", "metre")];
    let points = lake.grid().points();
    let at = |of: &dyn Fn(usize) -> usize| -> Vec<f64> {
        responses.pairs.iter().flat_map(|pair| position_m(&points[of(*pair as usize)])).collect()
    };
    let pair = |id: usize| lake.grid().pairs()[id];
    let listeners = at(&|id| pair(id).microphone.index());
    let sources = at(&|id| pair(id).speaker.index());
    let put = |name: &str, shape: &str, values: &[f64], attributes| {
        dimensions.write_dataset(file, name, shape, values, attributes)
    };
    put("ListenerPosition", "MC", &listeners, cartesian)?;
    put("ListenerView", "IC", &[1.0, 0.0, 0.0], cartesian)?;
    put("ListenerUp", "IC", &[0.0, 0.0, 1.0], &[])?;
    put("ReceiverPosition", "RCI", &[0.0; 3], cartesian)?;
    put("SourcePosition", "MC", &sources, cartesian)?;
    put("SourceView", "IC", &[1.0, 0.0, 0.0], cartesian)?;
    put("SourceUp", "IC", &[0.0, 0.0, 1.0], &[])?;
    put("EmitterPosition", "ECI", &[0.0; 3], cartesian)?;
    put("RoomTemperature", "I", &[reference + KELVIN], &[("Units", "kelvin")])?;
    let seconds: Vec<f64> = responses.log_time_ns.iter().map(|ns| (*ns as f64 / 1e9).floor()).collect();
    put("MeasurementDate", "M", &seconds, &[])?;
    let samples: Vec<f64> = responses.samples.iter().map(|x| f64::from(*x)).collect();
    put("Data.IR", "MRN", &samples, &[])?;
    put("Data.SamplingRate", "I", &[rig.sweep.rate_hz.get()], &[("Units", "hertz")])?;
    put("Data.Delay", "IR", &[0.0], &[])
}

fn position_m(point: &Point) -> [f64; 3] {
    point.position_mm.map(|mm| mm / 1e3)
}

impl Dimensions {
    fn create_scales(file: &H5File, sizes: &[(char, usize)]) -> std::result::Result<Self, Hdf5Error> {
        let mut all = Vec::new();
        for (letter, size) in sizes {
            let scale = file.new_dataset::<f32>().shape([*size]).create(&letter.to_string())?;
            scale.write_raw(&vec![0.0f32; *size])?;
            scale.set_scale(Some(&format!("{NO_VARIABLE}{size:10}")))?;
            all.push((*letter, *size, scale));
        }
        Ok(Self(all))
    }

    fn write_dataset(
        &self,
        file: &H5File,
        name: &str,
        shape: &str,
        values: &[f64],
        attributes: &[(&str, &str)],
    ) -> std::result::Result<(), Hdf5Error> {
        let found: Vec<_> = shape.chars().filter_map(|l| self.0.iter().find(|(letter, ..)| *letter == l)).collect();
        let sizes: Vec<usize> = found.iter().map(|(_, size, _)| *size).collect();
        let dataset = file.new_dataset::<f64>().shape(&sizes).create(name)?;
        dataset.write_raw(values)?;
        for (axis, (_, _, scale)) in found.into_iter().enumerate() {
            dataset.attach_scale(axis, scale)?;
        }
        for (key, value) in attributes {
            dataset.new_attr::<rust_hdf5::VarLenUnicode>().shape(()).create(key)?.write_string(value)?;
        }
        Ok(())
    }
}
