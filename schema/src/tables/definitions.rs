//! The columns of every table, in order; functions of bands get the names of the lake's.

use super::column::Column;
use crate::manifest::ORIGINS;
use crate::simulation::TRUSTED_PHASE;

fn run_keys() -> Vec<Column> {
    vec![
        Column::text("surface_id", "The measured surface, as 0015_0"),
        Column::text("run_id", "The run; its file is runs/<surface_id>/<run_id>.mcap"),
    ]
}

fn pair_keys() -> Vec<Column> {
    let mut columns = run_keys();
    columns.extend([
        Column::int("pair_id", "", "Pair, 0-based in (microphone, speaker) order; see table pairs"),
        Column::int("microphone", "", "Grid point of the microphone; see table points"),
        Column::int("speaker", "", "Grid point of the speaker; see table points"),
    ]);
    columns
}

fn log_time() -> Vec<Column> {
    vec![
        Column::long("log_time_ns", "ns", "Time of capture since 1970-01-01 UTC: log_time in the run's file"),
        Column::time("log_time", "Time of capture, UTC, cut to microseconds"),
    ]
}

fn code_version() -> Column {
    Column::text("code_version", "Version of the code that derived this row")
}

fn project_column() -> Column {
    Column::text("project", "Project that the run was recorded for; tokens of projects see the rows of their runs")
        .or_null()
}

fn reference_columns() -> Vec<Column> {
    vec![
        Column::text(
            "flat_version",
            "Which Flat normalised this row: surface, number of runs and digest of their data",
        ),
        Column::text("foam_version", "Which Foam was subtracted: surface, number of runs and digest of their data"),
    ]
}

pub(super) fn surface_columns(bands: &[String]) -> Vec<Column> {
    let mut columns = run_keys();
    columns.extend([
        Column::text("panel", "Physical panel that the surface is a side of"),
        Column::int("side", "", "Side of the panel, 0 or 1, where the name tells it").or_null(),
        Column::text("typology", "Kind of relief"),
        Column::text("macrostructure", "The large shape beneath the relief").or_null(),
        Column::text("mesostructure", "The relief's pattern").or_null(),
        Column::text("microstructure", "The finish").or_null(),
        Column::text("material", "Material").or_null(),
        Column::text("role", "hard: the absorption of others is measured beside it; sample: a level sample").or_null(),
        Column::double("reflection_factor", "1", "Pressure reflection factor of the simulation, if simulated")
            .or_null(),
        Column::text("flat_reference", "Surface that normalises this one"),
        Column::text("foam_reference", "Surface whose direct sound is subtracted from this one"),
        Column::text("macro_reference", "Surface that has the large shape of this one and nothing on it").or_null(),
        Column::text("parameters", "Parameters of the relief's generator, JSON"),
        Column::text("mesh_file", "Attachment of the run's file that holds the producer's mesh").or_null(),
        Column::long("mesh_triangles", "1", "Triangles of the mesh").or_null(),
        Column::flag("mesh_watertight", "Whether every edge of the mesh has two triangles").or_null(),
        Column::float("relief_min_mm", "mm", "Lowest point of the relief over the panel's reference plane").or_null(),
        Column::float("relief_max_mm", "mm", "Highest point of the relief over the panel's reference plane").or_null(),
        Column::float("relief_rms_mm", "mm", "Root mean square height of the relief about its mean").or_null(),
        Column::float("relief_area_ratio", "1", "Area of the relief over that of its plane").or_null(),
    ]);
    columns.extend(bands.iter().map(|band| {
        let comment = format!(
            "Phase, rad, of the relief's details narrower than a wavelength, root mean square; over {TRUSTED_PHASE} \
             simulated levels of single pairs are off by about 1 dB and more, band at {band} Hz"
        );
        Column::float(format!("detail_phase_{band}"), "1", comment).or_null()
    }));
    let far_field = [
        (
            "diffusion_normalised",
            "Directional diffusion coefficient normalised by that of a flat panel, as ISO 17497-2",
        ),
        ("far_scattering", "Scattering coefficient: share of the energy that is not mirrored"),
    ];
    for (name, coefficient) in far_field {
        columns.extend(bands.iter().flat_map(|band| {
            let comment = format!(
                "{coefficient}, random incidence, far field, band at {band} Hz; computed from the relief, not \
                 measured: by Kirchhoff's approximation, or exactly if it has ridges that repeat; null if \
                 far_field_reason_{band} says why"
            );
            let uncertainty = format!("Standard uncertainty of {name}_{band}");
            [
                Column::float(format!("{name}_{band}"), "1", comment).or_null(),
                Column::float(format!("{name}_u_{band}"), "1", uncertainty).or_null(),
            ]
        }));
    }
    columns.extend(bands.iter().map(|band| {
        let comment = format!("Why coefficients of the far field are missing, band at {band} Hz");
        Column::text(&format!("far_field_reason_{band}"), &comment).or_null()
    }));
    columns.extend([Column::text("origin", ORIGINS), project_column(), code_version()]);
    columns
}

pub(super) fn run_columns() -> Vec<Column> {
    let mut columns = run_keys();
    columns.extend([
        Column::text("state", "complete; waiting: references are missing; partial: the file was cut off"),
        Column::text("missing", "References that are missing, separated by commas; empty where none is"),
        Column::text("origin", ORIGINS),
        project_column(),
        Column::text("rig", "Name of the rig"),
        Column::long("started_ns", "ns", "Start since 1970-01-01 UTC"),
        Column::time("started", "Start, UTC"),
        Column::long("ended_ns", "ns", "End since 1970-01-01 UTC, or the last message of a partial run"),
        Column::time("ended", "End, UTC"),
        Column::long("measurements", "1", "Accepted measurements, rows of table measurements"),
        Column::long("rejected", "1", "Pairs that were given up"),
        Column::long("attempts", "1", "Attempts, the repeated ones included"),
        Column::long("damaged", "1", "Messages that could not be read"),
        Column::float("temperature_min_c", "C", "Lowest temperature").or_null(),
        Column::float("temperature_max_c", "C", "Highest temperature").or_null(),
        Column::float("humidity_min_pct", "%", "Lowest relative humidity").or_null(),
        Column::float("humidity_max_pct", "%", "Highest relative humidity").or_null(),
        Column::float("pressure_min_hpa", "hPa", "Lowest pressure").or_null(),
        Column::float("pressure_max_hpa", "hPa", "Highest pressure").or_null(),
        Column::text("file", "Path of the run's file in the lake"),
        Column::long("file_bytes", "B", "Size of the run's file"),
        Column::text("file_sha256", "SHA-256 of the run's file"),
        Column::text("recorded_by", "Program that wrote the run's file"),
        Column::text("run_derivation", "Derivation of the rows that come from the run alone"),
        Column::text("reference_derivation", "Derivation of the rows that need references; null without them")
            .or_null(),
        Column::text("flat_version", "Which Flat normalised the run's rows").or_null(),
        Column::text("foam_version", "Which Foam was subtracted from the run's rows").or_null(),
        code_version(),
    ]);
    columns
}

pub(super) fn point_columns() -> Vec<Column> {
    vec![
        Column::int("point_id", "", "Grid point, 0-based in (layer, gridx, gridy) order"),
        Column::int("layer", "", "Layer, 0 the lowest"),
        Column::int("gridx", "", "Column along x"),
        Column::int("gridy", "", "Row along y"),
        Column::double("x_mm", "mm", "x; origin at the panel's centre"),
        Column::double("y_mm", "mm", "y; origin at the panel's centre"),
        Column::double("z_mm", "mm", "Height over the panel's reference plane"),
    ]
}

pub(super) fn pair_columns() -> Vec<Column> {
    let mut columns = vec![
        Column::int("pair_id", "", "Pair, 0-based in (microphone, speaker) order"),
        Column::int("microphone", "", "Grid point of the microphone"),
        Column::int("speaker", "", "Grid point of the speaker"),
    ];
    columns.extend(position_columns());
    columns.extend([
        Column::double("direct_mm", "mm", "Direct path"),
        Column::double("image_mm", "mm", "Path by the mirror image in the reference plane"),
        Column::double("incidence_deg", "deg", "Angle of that path against the panel's normal"),
        Column::double("specular_x_mm", "mm", "x of the point of reflection"),
        Column::double("specular_y_mm", "mm", "y of the point of reflection"),
        Column::double(
            "fresnel_major_2000_mm",
            "mm",
            "First Fresnel zone at 2 kHz, diameter in the plane of incidence",
        ),
        Column::double("fresnel_minor_2000_mm", "mm", "First Fresnel zone at 2 kHz, diameter across it"),
        Column::double(
            "fresnel_major_40000_mm",
            "mm",
            "First Fresnel zone at 40 kHz, diameter in the plane of incidence",
        ),
        Column::double("fresnel_minor_40000_mm", "mm", "First Fresnel zone at 40 kHz, diameter across it"),
    ]);
    columns
}

fn position_columns() -> [Column; 6] {
    [
        Column::double("microphone_x_mm", "mm", "x of the microphone"),
        Column::double("microphone_y_mm", "mm", "y of the microphone"),
        Column::double("microphone_z_mm", "mm", "z of the microphone"),
        Column::double("speaker_x_mm", "mm", "x of the speaker"),
        Column::double("speaker_y_mm", "mm", "y of the speaker"),
        Column::double("speaker_z_mm", "mm", "z of the speaker"),
    ]
}

pub(super) fn measurement_columns() -> Vec<Column> {
    let mut columns = pair_keys();
    columns.extend(log_time());
    columns.extend([
        Column::int("attempt", "1", "Attempt that was accepted, 1 the first"),
        Column::text("verdict", "accepted; imports keep what they are given, and may say repeated or rejected"),
        Column::text("reasons", "What is wrong with it, separated by semicolons; empty where nothing is"),
        Column::double("temperature_c", "C", "Temperature that the response is corrected with"),
        Column::double("humidity_pct", "%", "Relative humidity").or_null(),
        Column::double("pressure_hpa", "hPa", "Pressure").or_null(),
        Column::float("outside_level_db", "dB re 20 uPa", "Sound pressure level outside").or_null(),
        Column::float(
            "snr_db",
            "dB",
            "Mean power of the response over that of the noise behind it, in the sweep's band",
        )
        .or_null(),
        Column::int("clipped_samples", "1", "Samples at full scale, both channels"),
        Column::float("arrival_error_us", "us", "Direct sound's arrival minus the one geometry gives").or_null(),
        Column::float("clock_ratio_ppm", "ppm", "Rate of the playing clock over that of the recording one, less 1")
            .or_null(),
        Column::float(
            "repeat_difference_db",
            "dB",
            "Energy of the difference between the responses of two takes over that of the first, noise included; null \
             without a second take",
        )
        .or_null(),
        Column::float("microphone_residual_mm", "mm", "Measured minus wanted position of the microphone").or_null(),
        Column::float("speaker_residual_mm", "mm", "Measured minus wanted position of the speaker").or_null(),
        Column::text(
            "source",
            "sweep: deconvolved from the recording; ir: taken as recorded; corrected: given at the \
            reference temperature",
        ),
        Column::long("chunk_offset", "B", "Where in the run's file the chunk begins that holds it"),
        Column::floats(
            "ir",
            "1",
            "Impulse response over the loopback, at the reference temperature, cropped; direct sound still in it; \
            rounded to 2^-20 of its greatest sample, unless lake.toml says exact",
        ),
        Column::floats(
            "measured_ir",
            "1",
            "The same response as measured, at no temperature but its own, as a room's parameters need it; null of \
            responses that are shorter than 50 ms, or were given at the reference temperature",
        )
        .or_null(),
        code_version(),
    ]);
    columns
}

pub(super) fn nce_columns(bands: &[String]) -> Vec<Column> {
    let mut columns = pair_keys();
    columns.push(Column::floats(
        "reflected_ir",
        "1",
        "Impulse response with Foam's subtracted; rounded to 2^-16 of its greatest sample, unless lake.toml says exact",
    ));
    columns.extend(bands.iter().map(|band| {
        let comment = format!(
            "Cumulative energy of the band at {band} Hz over Flat's total energy, along time; rounded to 2^-16 of its \
             last value, unless lake.toml says exact"
        );
        Column::floats(format!("nce_{band}"), "1", comment)
    }));
    columns.extend(reference_columns());
    columns.push(code_version());
    columns
}

fn energy_columns(bands: &[String]) -> Vec<Column> {
    let per_band = |prefix: &str, unit, comment: &str| -> Vec<Column> {
        let column = |band| Column::double(format!("{prefix}_{band}"), unit, format!("{comment}, band at {band} Hz"));
        bands.iter().map(column).collect()
    };
    let mut columns = per_band("tnce", "1", "Energy over Flat's total energy");
    columns.push(Column::double("tnce_total", "1", "Energy over Flat's total energy, all bands"));
    columns.extend(per_band("tnce_band", "1", "Energy over Flat's energy of the same band"));
    columns.extend(per_band("energy", "1", "Sum of squares of the reflected response"));
    columns.push(Column::double("energy_total", "1", "Sum of squares of the reflected response, all bands"));
    columns
}

pub(super) fn tnce_columns(bands: &[String]) -> Vec<Column> {
    let mut columns = pair_keys();
    columns.extend(energy_columns(bands));
    columns.extend(curve_shapes(bands));
    columns.extend(level_uncertainties(bands));
    columns.extend(reference_columns());
    columns.push(code_version());
    columns
}

fn curve_shapes(bands: &[String]) -> Vec<Column> {
    let quantities = [
        ("rise", "ms", "Time in which NCE rises from 10 % to 90 % of TNCE"),
        ("centre", "ms", "Centre of gravity of the reflected energy, from the response's first sample"),
        ("slope", "1/ms", "Mean slope of NCE between 10 % and 90 % of TNCE"),
    ];
    let column = |band: &str, (name, unit, comment): (&str, &'static str, &str)| {
        let suffix = unit.replace("1/", "per_");
        let comment = format!("{comment}, band at {band} Hz; null without energy");
        Column::float(format!("{name}_{band}_{suffix}"), unit, comment).or_null()
    };
    bands.iter().flat_map(|band| quantities.map(|quantity| column(band, quantity))).collect()
}

fn level_uncertainties(bands: &[String]) -> Vec<Column> {
    const COMMENT: &str =
        "from gain, delay and noise that the direct sound's subtraction leaves; null if it is not known";
    let column = |name: String| {
        let comment = format!("Standard uncertainty of the level of {name}, {COMMENT}");
        Column::float(format!("{name}_u_db"), "dB", comment).or_null()
    };
    let over_total = bands.iter().map(|band| format!("tnce_{band}")).chain(["tnce_total".to_owned()]);
    over_total.chain(bands.iter().map(|band| format!("tnce_band_{band}"))).map(column).collect()
}

pub(super) fn tnce_d4(bands: &[String]) -> Vec<Column> {
    let mut columns = pair_keys();
    columns.extend([
        Column::text("symmetry", "identity, rot90, rot180, rot270, mirror_x, mirror_y, mirror_diag or mirror_anti"),
        Column::flag("swapped", "Microphone and speaker changed places: the row relies on reciprocity"),
        Column::int("d4_pair_id", "", "The measured pair that this one becomes"),
        Column::int("d4_microphone", "", "Grid point of the microphone after it"),
        Column::int("d4_speaker", "", "Grid point of the speaker after it"),
    ]);
    columns.extend(position_columns());
    columns.extend(energy_columns(bands));
    columns.extend(reference_columns());
    columns.push(code_version());
    columns
}

pub(super) fn heightmap_columns() -> Vec<Column> {
    let mut columns = run_keys();
    columns.extend([
        Column::text("symmetry", "identity, rot90, rot180, rot270, mirror_x, mirror_y, mirror_diag or mirror_anti"),
        Column::int("cells", "1", "Cells along each side"),
        Column::float("size_mm", "mm", "Edge of the square"),
        Column::floats("heights_mm", "mm", "Mean height of each cell, row by row along x, y ascending"),
        code_version(),
    ]);
    columns
}

pub(super) fn environment_columns() -> Vec<Column> {
    let mut columns = run_keys();
    columns.extend(log_time());
    columns.extend([
        Column::double("temperature_c", "C", "Temperature"),
        Column::double("humidity_pct", "%", "Relative humidity"),
        Column::double("pressure_hpa", "hPa", "Pressure"),
        Column::float("outside_level_db", "dB re 20 uPa", "Sound pressure level outside"),
        code_version(),
    ]);
    columns
}

pub(super) fn event_columns() -> Vec<Column> {
    let mut columns = run_keys();
    columns.extend(log_time());
    columns.extend([
        Column::text("level", "unknown, debug, info, warning, error or fatal"),
        Column::text("name", "Part of the system that said it"),
        Column::text("message", "What it said"),
        code_version(),
    ]);
    columns
}

pub(super) fn surface_stats() -> Vec<Column> {
    let mut columns = run_keys();
    columns.extend([
        Column::text("band", "Centre of the band in Hz, or total"),
        Column::double("band_hz", "Hz", "Centre of the band; null for the total").or_null(),
        Column::int("measurements", "1", "Measurements that the row sums up"),
        Column::double("p90_mean_db", "dB re Flat total", "Mean of the TNCE values up to their 90th percentile")
            .or_null(),
        Column::double("p5_db", "dB re Flat total", "5th percentile of TNCE").or_null(),
        Column::double("p50_db", "dB re Flat total", "Median of TNCE").or_null(),
        Column::double("p95_db", "dB re Flat total", "95th percentile of TNCE").or_null(),
        Column::double("min_db", "dB re Flat total", "Least TNCE").or_null(),
        Column::double("max_db", "dB re Flat total", "Greatest TNCE").or_null(),
        Column::double("spread_db", "dB", "Standard deviation of TNCE in dB over the pairs").or_null(),
        Column::double(
            "p90_mean_u_db",
            "dB",
            "Standard uncertainty of p90_mean_db, from that of each measurement; null if it is not known",
        )
        .or_null(),
        Column::double(
            "unbiased_p90_mean_db",
            "dB re Flat total",
            "p90_mean_db without Foam's own reflection, which is estimated from Foam and Flat; null if it cannot be",
        )
        .or_null(),
        Column::double(
            "unbiased_p90_mean_u_db",
            "dB",
            "Standard uncertainty of unbiased_p90_mean_db, from p90_mean_u_db and the estimate's own error; null if \
            either is not known",
        )
        .or_null(),
        Column::double(
            "energy_over_flat",
            "1",
            "Reflected energy over Flat's in the octave around the band (IEC 61260-1), sums over the pairs, without \
             Foam's own reflection; null if the sweep begins or ends within the octave",
        )
        .or_null(),
        Column::double("energy_over_flat_u", "1", "Its standard uncertainty, the jackknife over ninths of the panel")
            .or_null(),
        Column::double(
            "scattering",
            "1",
            "Share of the octave's reflected energy that is not mirrored: 1 less the coherence with Flat over the \
             places, after Mommertz (2000)",
        )
        .or_null(),
        Column::double("scattering_u", "1", "Its standard uncertainty, the jackknife over ninths of the panel")
            .or_null(),
        Column::double(
            "specular_loss",
            "1",
            "Share of Flat's energy in the octave that is not mirrored: the scattering of ISO 17497-1 of a surface \
             that absorbs as Flat",
        )
        .or_null(),
        Column::double("specular_loss_u", "1", "Its standard uncertainty, the jackknife over ninths of the panel")
            .or_null(),
        Column::floats("mean_nce", "1", "Mean of the NCE curves over the pairs, along time; total is the bands' sum")
            .or_null(),
    ]);
    columns.extend(reference_columns());
    columns.push(code_version());
    columns
}
