//! Numbers and texts of an HDF5 file, read in windows of rows, so that a dataset may be larger than the memory.

use std::path::Path;

use hdf5_pure::{
    AttrValue, Dataset, Datatype, DatatypeByteOrder, Error as Hdf5Error, File, FloatingPointLayout, FormatError, Group,
    Layout,
};

/// Most numbers that are returned at once: 4 GB of them.
const MOST: usize = 1 << 29;
/// Numbers of a window of rows: 32 MB.
const WINDOW_NUMBERS: usize = 1 << 22;
/// Most numbers of one row, which is read as a whole: 1 GB.
const MOST_ROW_NUMBERS: usize = 1 << 27;
/// Most bytes that one byte of a file may stand for, by deflate; a file that says more is damaged or a trap.
const MOST_PACKED: u64 = 1100;
/// Most names of variables, and levels of groups, that are listed: links may lead in circles.
const MOST_NAMES: usize = 1000;
const MOST_LEVELS: usize = 16;

/// A file that is read.
pub(crate) struct Hdf5File {
    file: File,
    size_bytes: u64,
}

/// A variable that is in memory.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Hdf5Variable {
    pub shape: Vec<usize>,
    pub values: Vec<f64>,
}

/// A variable of a file, of which parts are read.
pub(crate) struct Hdf5Dataset {
    dataset: Dataset,
    pub shape: Vec<usize>,
    /// Rows that are stored together.
    pub chunk_rows: usize,
    packing: NumberPacking,
}

/// How numbers are stored, by the attributes that netCDF gives a variable.
struct NumberPacking {
    factor: f64,
    offset: f64,
    /// Stored numbers that stand for none.
    missing: Vec<f64>,
}

impl Hdf5File {
    pub fn open(path: &Path) -> Result<Self, String> {
        let size_bytes = std::fs::metadata(path).map_err(|e| e.to_string())?.len();
        let file = File::open_streaming(path).map_err(describe_error)?;
        Ok(Self { file, size_bytes })
    }

    /// Returns an attribute of the file; empty if it is missing.
    pub fn root_text(&self, name: &str) -> String {
        let found = self.file.root().attrs().ok().and_then(|mut attributes| attributes.remove(name));
        found.as_ref().and_then(AttrValue::as_str).unwrap_or_default().to_owned()
    }

    /// Returns an attribute of a variable; empty if it is missing.
    pub fn text_of(&self, variable: &str, name: &str) -> String {
        let found = self.read_attribute(variable, name).ok().flatten();
        found.as_ref().and_then(AttrValue::as_str).unwrap_or_default().to_owned()
    }

    /// Returns a number that is an attribute of a variable.
    pub fn number_of(&self, variable: &str, name: &str) -> Result<f64, String> {
        let found = self.read_attribute(variable, name).map_err(describe_error)?.ok_or("it is missing")?;
        attribute_number(&found)
    }

    fn read_attribute(&self, variable: &str, name: &str) -> Result<Option<AttrValue>, Hdf5Error> {
        Ok(self.file.dataset(variable)?.attrs()?.remove(name))
    }

    /// Returns the paths of variables, of a file with very many only the first.
    pub fn variable_names(&self) -> Vec<String> {
        let mut names = Vec::new();
        let mut groups: Vec<(Group, String, usize)> = vec![(self.file.root(), String::new(), 0)];
        let mut seen = 0;
        while let Some((group, path, level)) = groups.pop().filter(|_| seen < MOST_NAMES && names.len() < MOST_NAMES) {
            seen += 1;
            let mut found = group.datasets().unwrap_or_default();
            found.sort();
            names.extend(found.into_iter().map(|name| format!("{path}{name}")));
            let below = group.groups().unwrap_or_default().into_iter().filter(|_| level < MOST_LEVELS);
            groups.extend(below.filter_map(|n| Some((group.group(&n).ok()?, format!("{path}{n}/"), level + 1))));
        }
        names
    }

    /// Opens a variable; None if it is missing.
    pub fn open_dataset(&self, name: &str) -> Result<Option<Hdf5Dataset>, String> {
        let dataset = match self.file.dataset(name) {
            Err(Hdf5Error::Format(FormatError::PathNotFound(_)) | Hdf5Error::NotAGroup(_)) => return Ok(None),
            opened => opened.map_err(describe_error)?,
        };
        let sizes = |sizes: Vec<u64>| sizes.into_iter().map(|n| usize::try_from(n).unwrap_or(usize::MAX)).collect();
        let shape: Vec<usize> = sizes(dataset.shape().map_err(describe_error)?);
        check_datatype(&dataset.datatype().map_err(describe_error)?)?;
        let packing = NumberPacking::from_attributes(&dataset)?;
        let width = dataset.element_size().map_err(describe_error)?;
        let has_room = |shape: &[usize]| {
            let size = shape.iter().try_fold(width, |size, n| size.checked_mul(*n as u64));
            size.is_some_and(|size| size <= self.size_bytes.saturating_mul(MOST_PACKED))
        };
        if !has_room(&shape) {
            return Err(format!("{shape:?} numbers, more than a file of {} bytes can hold", self.size_bytes));
        }
        let mut chunk_rows = 1;
        if matches!(dataset.layout().map_err(describe_error)?, Layout::Chunked { .. }) {
            let chunk: Vec<usize> = sizes(dataset.chunk_shape().map_err(describe_error)?.unwrap_or_default());
            let chunks = dataset.chunks().map_err(describe_error)?;
            let ends = chunks.iter().map(|chunk| chunk.address.saturating_add(chunk.storage_size));
            if !has_room(&chunk) || ends.max().is_some_and(|end| end > self.size_bytes) {
                return Err(format!("chunks of {chunk:?} numbers that are not in the file; it is damaged or cut off"));
            }
            chunk_rows = chunk.first().copied().unwrap_or(1).max(1);
        }
        Ok(Some(Hdf5Dataset { dataset, shape, chunk_rows, packing }))
    }

    /// Reads a variable; None if it is missing.
    pub fn read_variable(&self, name: &str) -> Result<Option<Hdf5Variable>, String> {
        let Some(dataset) = self.open_dataset(name)? else { return Ok(None) };
        let values = dataset.read_block(&vec![0; dataset.shape.len()], &dataset.shape)?;
        Ok(Some(Hdf5Variable { shape: dataset.shape, values }))
    }
}

impl Hdf5Dataset {
    /// Reads the block of `counts` numbers that begins at `starts`, row by row. Rows are read with all that is in them.
    pub fn read_block(&self, starts: &[usize], counts: &[usize]) -> Result<Vec<f64>, String> {
        let count = counts.iter().try_fold(1usize, |count, n| count.checked_mul(*n)).filter(|n| *n <= MOST);
        let count = count.ok_or_else(|| format!("{counts:?} numbers, more than {MOST}"))?;
        let (&[start, ref starts @ ..], &[rows, ref counts @ ..], [_, within @ ..]) = (starts, counts, &self.shape[..])
        else {
            let mut values = self.dataset.read_f64().map_err(describe_error)?;
            self.packing.unpack_numbers(&mut values);
            return Ok(values);
        };
        let row: usize = within.iter().product();
        if row > MOST_ROW_NUMBERS {
            return Err(format!(
                "{row} numbers for each of its first dimension, more than {MOST_ROW_NUMBERS}; hint: bring a longer \
                 dimension to the front"
            ));
        }
        let mut values = Vec::with_capacity(count);
        if count == 0 {
            return Ok(values);
        }
        // Windows end where chunks do, if they can.
        let most = (WINDOW_NUMBERS / row).max(1);
        let step = if most > self.chunk_rows { most - most % self.chunk_rows } else { most };
        let mut at = start;
        let end = start + rows;
        while at < end {
            let next = end.min((at / step + 1) * step);
            let window = self.dataset.read_f64_rows(at as u64, (next - at) as u64).map_err(describe_error)?;
            if window.len() != (next - at) * row {
                return Err(format!("{} numbers in {} rows, expected {row} in each", window.len(), next - at));
            }
            window.chunks_exact(row).for_each(|row| append_block(row, within, starts, counts, &mut values));
            at = next;
        }
        self.packing.unpack_numbers(&mut values);
        Ok(values)
    }
}

impl NumberPacking {
    fn from_attributes(dataset: &Dataset) -> Result<Self, String> {
        let attributes = dataset.attrs().map_err(describe_error)?;
        let number = |name: &str| {
            let number = attributes.get(name).map(attribute_number).transpose();
            number.map_err(|fault| format!("its attribute `{name}` is {fault}"))
        };
        let missing = [number("_FillValue")?, number("missing_value")?].into_iter().flatten().collect();
        Ok(Self {
            factor: number("scale_factor")?.unwrap_or(1.0),
            offset: number("add_offset")?.unwrap_or(0.0),
            missing,
        })
    }

    // A missing number becomes NaN, which no reader takes for a sample or a position.
    fn unpack_numbers(&self, values: &mut [f64]) {
        if self.factor == 1.0 && self.offset == 0.0 && self.missing.is_empty() {
            return;
        }
        for x in values {
            *x = if self.missing.contains(x) { f64::NAN } else { *x * self.factor + self.offset };
        }
    }
}

fn attribute_number(found: &AttrValue) -> Result<f64, String> {
    let number = found.as_f64().or_else(|| found.as_i64().map(|integer| integer as f64));
    number.ok_or_else(|| format!("{} and not one number", found.type_name()))
}

// The library returns no numbers of other types, and no error.
fn check_datatype(datatype: &Datatype) -> Result<(), String> {
    let is_read = match datatype {
        Datatype::Enumeration { base_type, .. } => return check_datatype(base_type),
        Datatype::FixedPoint { size, byte_order, layout } => {
            matches!(size, 1 | 2 | 4 | 8)
                && *byte_order != DatatypeByteOrder::Vax
                && layout.bit_offset == 0
                && u32::from(layout.bit_precision) == 8 * size
        }
        Datatype::FloatingPoint { size, byte_order, layout } => {
            let standard = [(4, FloatingPointLayout::IEEE754_BINARY32), (8, FloatingPointLayout::IEEE754_BINARY64)];
            *byte_order != DatatypeByteOrder::Vax && standard.contains(&(*size, *layout))
        }
        _ => false,
    };
    if is_read {
        return Ok(());
    }
    let layout = match datatype {
        Datatype::FloatingPoint { layout, .. } => format!(
            " ({} bits of exponent, of bias {}, and {} of mantissa)",
            layout.exponent_size, layout.exponent_bias, layout.mantissa_size
        ),
        _ => String::new(),
    };
    Err(format!(
        "numbers of type {datatype}{layout}; integers of 8, 16, 32 and 64 bits and IEEE floats of 32 and 64 are read; \
         hint: `astype` of h5py makes one of the other"
    ))
}

// Appends the block of `counts` numbers that begins at `starts`.
fn append_block(values: &[f64], shape: &[usize], starts: &[usize], counts: &[usize], out: &mut Vec<f64>) {
    match shape {
        [] => out.extend(values),
        [_] => out.extend(&values[starts[0]..starts[0] + counts[0]]),
        [_, within @ ..] => {
            let step: usize = within.iter().product();
            let rows = values.chunks_exact(step).skip(starts[0]).take(counts[0]);
            rows.for_each(|row| append_block(row, within, &starts[1..], &counts[1..], out));
        }
    }
}

// The place of a number in a grid, row by row.
pub(crate) fn place_in_grid(number: usize, grid: &[usize]) -> Vec<usize> {
    let mut left = number;
    let mut at = vec![0; grid.len()];
    for (i, n) in grid.iter().enumerate().rev() {
        at[i] = left % n;
        left /= n;
    }
    at
}

// What of the format is not read can be written in another way.
fn describe_error(error: Hdf5Error) -> String {
    let hint = match &error {
        Hdf5Error::Format(FormatError::UnsupportedExternalStorage | FormatError::UnsupportedVirtualLayout) => {
            return "its numbers are in other files; hint: `h5repack` brings them into one".to_owned();
        }
        Hdf5Error::Format(FormatError::UnsupportedFilter(_)) => "; hint: `h5repack -f NONE` unpacks it",
        Hdf5Error::Format(FormatError::InvalidLayoutVersion(_) | FormatError::ChunkedReadError(_)) => {
            "; hint: `h5repack -l CONTI` writes it without chunks"
        }
        _ => "",
    };
    format!("{error}{hint}")
}

#[cfg(test)]
mod tests {
    use hdf5_pure::{FileBuilder, ScaleOffset};

    use super::*;

    #[test]
    fn blocks_are_cut_out_of_rows_and_chunks() {
        let folder = tempfile::tempdir().expect("a folder");
        let shape = [5, 7];
        let numbers: Vec<f64> = (0..35).map(|i| f64::from(i / 7 * 10 + i % 7)).collect();
        let mut builder = FileBuilder::new();
        builder.create_dataset("plain").with_f64_data(&numbers).with_shape(&[5, 7]);
        let packed = builder.create_dataset("packed").with_f64_data(&numbers).with_shape(&[5, 7]);
        packed.with_chunks(&[2, 3]).with_shuffle().with_deflate(5).with_fletcher32();
        let integers: Vec<i32> = numbers.iter().map(|x| *x as i32).collect();
        let packed = builder.create_dataset("integers").with_i32_data(&integers).with_shape(&[5, 7]);
        packed.with_chunks(&[3, 7]).with_lzf();
        let path = folder.path().join("set.h5");
        builder.write(&path).expect("written");
        let file = Hdf5File::open(&path).expect("opened");
        for name in ["plain", "/packed", "integers"] {
            let dataset = file.open_dataset(name).expect("opened").expect("there");
            assert_eq!(dataset.shape, shape);
            for start in (0..35).map(|i| place_in_grid(i, &shape)) {
                for end in
                    (0..35).map(|i| place_in_grid(i, &shape)).filter(|end| end[0] >= start[0] && end[1] >= start[1])
                {
                    let counts: Vec<usize> = end.iter().zip(&start).map(|(end, start)| end - start + 1).collect();
                    let cells = (0..counts[0] * counts[1]).map(|i| place_in_grid(i, &counts));
                    let expected: Vec<f64> = cells.map(|c| ((start[0] + c[0]) * 10 + start[1] + c[1]) as f64).collect();
                    assert_eq!(
                        dataset.read_block(&start, &counts).as_ref(),
                        Ok(&expected),
                        "{name}: {start:?} to {end:?}"
                    );
                }
            }
        }
        assert!(file.open_dataset("missing").expect("no fault").is_none());
        assert_eq!(file.variable_names(), ["integers", "packed", "plain"]);
    }

    /// E27: a type that is not read is named; the library would return no number of it.
    #[test]
    fn other_types_of_numbers_are_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("set.h5");
        let float = |size: u32, exponent_size: u8, exponent_bias: u32| Datatype::FloatingPoint {
            size,
            byte_order: DatatypeByteOrder::LittleEndian,
            layout: FloatingPointLayout {
                bit_offset: 0,
                bit_precision: 8 * size as u16,
                exponent_location: 8 * size as u8 - 1 - exponent_size,
                exponent_size,
                mantissa_location: 0,
                mantissa_size: 8 * size as u8 - 1 - exponent_size,
                exponent_bias,
            },
        };
        let integer = |size: u32, bit_precision: u16| Datatype::FixedPoint {
            size,
            byte_order: DatatypeByteOrder::BigEndian,
            layout: hdf5_pure::FixedPointLayout { signed: true, bit_offset: 0, bit_precision },
        };
        let types = [
            ("half", 2, float(2, 5, 15), "f16"),
            ("odd", 4, float(4, 8, 120), "(8 bits of exponent, of bias 120, and 23 of mantissa)"),
            ("narrow", 4, integer(4, 20), "i32"),
            ("three", 3, integer(3, 24), "i24"),
        ];
        let mut builder = FileBuilder::new();
        for (name, size, datatype, _) in &types {
            builder.create_dataset(name).with_raw_data(datatype.clone(), vec![1; 3 * size], 3);
        }
        builder.create_dataset("plain").with_raw_data(integer(2, 16), vec![1, 0, 255, 255], 2);
        builder.write(&path).expect("written");
        let file = Hdf5File::open(&path).expect("opened");
        for (name, _, _, expected) in types {
            let fault = file.read_variable(name).expect_err(name);
            assert!(fault.starts_with("numbers of type ") && fault.contains(expected), "{name}: {fault}");
        }
        assert_eq!(file.read_variable("plain").expect("read").expect("there").values, [256.0, -1.0]);
    }

    /// E27: numbers are those that netCDF's attributes say, a missing one is none.
    #[test]
    fn packed_numbers_are_unpacked() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("set.h5");
        let mut builder = FileBuilder::new();
        let packed = builder.create_dataset("packed").with_i16_data(&[-5_000, 0, 5_000, -32_768]).with_shape(&[2, 2]);
        packed.set_attr("scale_factor", AttrValue::F64(1e-4)).set_attr("add_offset", AttrValue::F32Array(vec![0.25]));
        packed.set_attr("_FillValue", AttrValue::I16(-32_768));
        let odd = builder.create_dataset("odd").with_i16_data(&[1]);
        odd.set_attr("scale_factor", AttrValue::String("0.1".to_owned()));
        builder.write(&path).expect("written");
        let file = Hdf5File::open(&path).expect("opened");
        let values = file.read_variable("packed").expect("read").expect("there").values;
        let expected = [-0.25, 0.25, 0.75];
        assert!(values.iter().zip(expected).all(|(x, expected)| (x - expected).abs() < 1e-12), "{values:?}");
        assert!(values.len() == 4 && values[3].is_nan(), "{values:?}");
        let fault = file.read_variable("odd").expect_err("a text");
        assert!(fault.starts_with("its attribute `scale_factor` is ") && fault.ends_with("not one number"), "{fault}");
    }

    #[test]
    fn numbers_that_no_file_of_its_size_has_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("hollow.h5");
        let mut builder = FileBuilder::new();
        // Equal numbers are packed to a bit each, and equal bits by a thousand.
        let hollow = builder.create_dataset("hollow").with_i32_data(&vec![7; 1 << 22]).with_chunks(&[1 << 20]);
        hollow.with_scale_offset(ScaleOffset::Integer(0)).with_deflate(9);
        builder.write(&path).expect("written");
        let fault = Hdf5File::open(&path).and_then(|file| file.read_variable("hollow")).err().unwrap_or_default();
        assert!(fault.contains("more than a file of"), "{fault:?}");
    }

    // Written by h5py, then opened again, `RoomTemperature` renamed to `x`, and `w1` deleted: the group's heap has both
    // names still.
    #[test]
    fn links_that_are_gone_are_not_read() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("renamed_links.h5");
        std::fs::write(&path, include_bytes!("../../../tests/fixtures/renamed_links.h5")).expect("written");
        let file = Hdf5File::open(&path).expect("opened");
        let value = |name: &str| file.read_variable(name).expect("no fault").map(|found| found.values);
        assert_eq!([value("RoomTemperature"), value("w1")], [None, None]);
        assert_eq!([value("x"), value("/w2"), value("v7")], [Some(vec![293.15]), Some(vec![2.0]), Some(vec![7.0])]);
        assert_eq!(file.variable_names(), ["v0", "v1", "v2", "v3", "v4", "v5", "v6", "v7", "w0", "w2", "x"]);
    }

    #[test]
    fn places_count_row_by_row() {
        assert_eq!((0..6).map(|n| place_in_grid(n, &[2, 3])).collect::<Vec<_>>()[3..5], [vec![1, 0], vec![1, 1]]);
    }
}
