//! Numbers and texts of an HDF5 file. What netCDF and h5py pack (deflate, bytes shuffled) is unpacked here.

use std::path::Path;

use rust_hdf5::{ByteOrder, DatatypeMessage, Filter, H5Dataset, H5File, Hdf5Error, ReadNumeric, StorageLayout};

/// HDF5's numbers of its filters.
const DEFLATE: u16 = 1;
const SHUFFLE: u16 = 2;
const CHECKSUM: u16 = 3;
/// Most numbers that are read at once: 4 GB of them.
const MOST: usize = 1 << 29;
/// Most bytes that one byte of a file may stand for, by deflate; a file that says more is damaged or a trap.
const MOST_PACKED: u64 = 1100;

/// A file that is read.
pub(super) struct Hdf5File {
    file: H5File,
    size_bytes: u64,
}

/// A variable that is in memory.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Hdf5Variable {
    pub(super) shape: Vec<usize>,
    pub(super) values: Vec<f64>,
}

/// A variable of a file, of which parts are read.
pub(super) struct Hdf5Dataset {
    dataset: H5Dataset,
    filters: Vec<Filter>,
    pub(super) shape: Vec<usize>,
}

impl Hdf5File {
    pub(super) fn open(path: &Path) -> Result<Self, String> {
        let size_bytes = std::fs::metadata(path).map_err(|e| e.to_string())?.len();
        let file = H5File::open(path).map_err(|e| e.to_string())?;
        Ok(Self { file, size_bytes })
    }

    /// Returns an attribute of the file; empty if it is missing.
    pub(super) fn text(&self, name: &str) -> String {
        // Fixed lengths are filled up with zeros.
        self.file.attr_string(name).map(|text| text.trim_end_matches('\0').to_owned()).unwrap_or_default()
    }

    /// Returns an attribute of a variable; empty if it is missing.
    pub(super) fn text_of(&self, variable: &str, name: &str) -> String {
        let read = self.file.dataset(variable.trim_start_matches('/')).and_then(|d| d.attr(name)?.read_string());
        read.map(|text| text.trim_end_matches('\0').to_owned()).unwrap_or_default()
    }

    /// Returns a number that is an attribute of a variable.
    pub(super) fn number_of(&self, variable: &str, name: &str) -> Result<f64, String> {
        let attribute = self.file.dataset(variable.trim_start_matches('/')).and_then(|d| d.attr(name));
        let attribute = attribute.map_err(|e| e.to_string())?;
        let numbers = attribute.read_numeric_as::<f64>().or_else(|_| {
            let integers = attribute.read_numeric_as::<i32>();
            integers.map(|integers| integers.into_iter().map(f64::from).collect())
        });
        match numbers.map_err(|e| e.to_string())?.as_slice() {
            [number] => Ok(*number),
            several => Err(format!("{} numbers", several.len())),
        }
    }

    /// Returns the paths of all variables.
    pub(super) fn names(&self) -> Vec<String> {
        self.file.dataset_names()
    }

    /// Opens a variable; None if it is missing.
    pub(super) fn dataset(&self, name: &str) -> Result<Option<Hdf5Dataset>, String> {
        let name = name.trim_start_matches('/');
        if !self.names().iter().any(|known| known == name) {
            return Ok(None);
        }
        let failed = |e: Hdf5Error| e.to_string();
        let dataset = self.file.dataset(name).map_err(failed)?;
        let elsewhere = matches!(dataset.storage_layout().map_err(failed)?, StorageLayout::Virtual)
            || !dataset.external_files().map_err(failed)?.is_empty();
        if elsewhere {
            return Err("its numbers are in other files; hint: `h5repack` brings them into one".into());
        }
        let shape = dataset.shape();
        let filters = dataset.filters().map_err(failed)?;
        let width = dataset.element_size() as u64;
        let size = shape.iter().try_fold(width, |size, n| size.checked_mul(*n as u64));
        if size.is_none_or(|size| size > self.size_bytes.saturating_mul(MOST_PACKED)) {
            return Err(format!("{shape:?} numbers, more than a file of {} bytes can hold", self.size_bytes));
        }
        Ok(Some(Hdf5Dataset { dataset, filters, shape }))
    }

    /// Reads a variable; None if it is missing.
    pub(super) fn variable(&self, name: &str) -> Result<Option<Hdf5Variable>, String> {
        let Some(dataset) = self.dataset(name)? else { return Ok(None) };
        let values = dataset.read(&vec![0; dataset.shape.len()], &dataset.shape)?;
        Ok(Some(Hdf5Variable { shape: dataset.shape, values }))
    }
}

impl Hdf5Dataset {
    /// Returns the shape of its chunks; None if it is stored as one piece.
    pub(super) fn chunk_shape(&self) -> Option<Vec<usize>> {
        self.dataset.chunk_dims().filter(|c| c.len() == self.shape.len() && !c.is_empty() && !c.contains(&0))
    }

    /// Reads the block of `counts` numbers that begins at `starts`, row by row.
    pub(super) fn read(&self, starts: &[usize], counts: &[usize]) -> Result<Vec<f64>, String> {
        let count = counts.iter().try_fold(1usize, |count, n| count.checked_mul(*n)).filter(|n| *n <= MOST);
        let count = count.ok_or_else(|| format!("{counts:?} numbers, more than {MOST}"))?;
        let values = match self.filters.is_empty() {
            true => self.read_plain(starts, counts)?,
            false => self.read_packed(starts, counts)?,
        };
        match values.len() == count {
            true => Ok(values),
            false => Err(format!("{} numbers, expected {count}", values.len())),
        }
    }

    // Writers differ in whether a rate is an integer.
    fn read_plain(&self, starts: &[usize], counts: &[usize]) -> Result<Vec<f64>, String> {
        match self.read_numbers::<f64>(starts, counts) {
            Ok(values) => Ok(values),
            Err(first) => match self.read_numbers::<i32>(starts, counts) {
                Ok(values) => Ok(values.into_iter().map(f64::from).collect()),
                Err(_) => Err(first.to_string()),
            },
        }
    }

    fn read_numbers<T: ReadNumeric>(&self, starts: &[usize], counts: &[usize]) -> Result<Vec<T>, Hdf5Error> {
        match starts.is_empty() {
            true => self.dataset.read_numeric_as(),
            false => self.dataset.read_numeric_slice_as(starts, counts),
        }
    }

    fn read_packed(&self, starts: &[usize], counts: &[usize]) -> Result<Vec<f64>, String> {
        let failed = |e: Hdf5Error| e.to_string();
        let filters = &self.filters;
        if let Some(unknown) = filters.iter().find(|f| ![DEFLATE, SHUFFLE, CHECKSUM].contains(&f.id)) {
            return Err(format!("it is packed by HDF5's filter {}; hint: `h5repack -f NONE` unpacks it", unknown.id));
        }
        let width = match self.dataset.datatype().map_err(failed)? {
            DatatypeMessage::FloatingPoint { size, byte_order: ByteOrder::LittleEndian, .. }
                if size == 4 || size == 8 =>
            {
                size as usize
            }
            other => return Err(format!("numbers are {other:?}; hint: `h5repack -f NONE` unpacks them")),
        };
        let chunk = self.chunk_shape().ok_or("it is packed without chunks")?;
        let cells = chunk.iter().try_fold(1usize, |n, d| n.checked_mul(*d)).filter(|n| *n <= MOST);
        let cells = cells.ok_or_else(|| format!("chunks of {chunk:?} numbers"))?;
        let mut values = vec![0.0; counts.iter().product()];
        if values.is_empty() {
            return Ok(values);
        }
        let first: Vec<usize> = starts.iter().zip(&chunk).map(|(start, c)| start / c).collect();
        let ends = starts.iter().zip(counts).zip(&chunk).map(|((start, n), c)| (start + n).div_ceil(*c));
        let grid: Vec<usize> = ends.zip(&first).map(|(end, first)| end - first).collect();
        for number in 0..grid.iter().product() {
            let at: Vec<usize> = place(number, &grid).iter().zip(&first).map(|(i, first)| i + first).collect();
            let (raw, mask) = self.dataset.read_chunk_raw_at(&at).map_err(failed)?;
            let bytes = unpacked(raw, filters, mask, width, cells * width)?;
            let corner: Vec<usize> = at.iter().zip(&chunk).map(|(a, c)| a * c).collect();
            copy_overlap(&bytes, &chunk, &corner, &mut values, counts, starts);
        }
        Ok(values)
    }
}

// Copies what a chunk at `corner` has of the block of `counts` numbers at `starts`; a chunk may reach beyond it.
fn copy_overlap(
    bytes: &[u8],
    chunk: &[usize],
    corner: &[usize],
    values: &mut [f64],
    counts: &[usize],
    starts: &[usize],
) {
    let last = chunk.len() - 1;
    let width = bytes.len() / chunk.iter().product::<usize>();
    // Along the last dimension, numbers of both lie side by side.
    let from = starts[last].max(corner[last]);
    let to = (starts[last] + counts[last]).min(corner[last] + chunk[last]);
    if from >= to {
        return;
    }
    for (row, bytes) in bytes.chunks_exact(width * chunk[last]).enumerate() {
        let within = place(row, &chunk[..last]);
        let row_of_block = (0..last).try_fold(0, |index, i| {
            let i_of_block = (corner[i] + within[i]).checked_sub(starts[i]).filter(|at| *at < counts[i])?;
            Some(index * counts[i] + i_of_block)
        });
        let Some(row_of_block) = row_of_block else { continue };
        let found = bytes.chunks_exact(width).skip(from - corner[last]);
        let wanted = &mut values[row_of_block * counts[last]..][from - starts[last]..to - starts[last]];
        wanted.iter_mut().zip(found).for_each(|(value, bytes)| *value = number_of(bytes));
    }
}

// The place of a number in a grid, row by row.
pub(super) fn place(number: usize, grid: &[usize]) -> Vec<usize> {
    let (mut left, mut at) = (number, vec![0; grid.len()]);
    for (i, n) in grid.iter().enumerate().rev() {
        at[i] = left % n;
        left /= n;
    }
    at
}

fn number_of(bytes: &[u8]) -> f64 {
    match *bytes {
        [a, b, c, d] => f64::from(f32::from_le_bytes([a, b, c, d])),
        [a, b, c, d, e, f, g, h] => f64::from_le_bytes([a, b, c, d, e, f, g, h]),
        _ => f64::NAN,
    }
}

// Undoes the filters from the last to the first; bit i of the mask says that filter i was left out.
fn unpacked(mut bytes: Vec<u8>, filters: &[Filter], mask: u32, width: usize, size: usize) -> Result<Vec<u8>, String> {
    for (i, filter) in filters.iter().enumerate().rev().filter(|(i, _)| mask >> i & 1 == 0) {
        bytes = match filter.id {
            DEFLATE => miniz_oxide::inflate::decompress_to_vec_zlib_with_limit(&bytes, size + 4)
                .map_err(|e| format!("filter {i}: a chunk is damaged: {e}"))?,
            SHUFFLE => unshuffled(&bytes, width),
            // What it is worth, deflate's own checksum is worth, too.
            _ => bytes.get(..bytes.len().saturating_sub(4)).unwrap_or_default().to_vec(),
        };
    }
    match bytes.len() == size {
        true => Ok(bytes),
        false => Err(format!("a chunk of {} bytes, expected {size}", bytes.len())),
    }
}

// The first bytes of all numbers come first, then the second ones, and so on.
fn unshuffled(bytes: &[u8], width: usize) -> Vec<u8> {
    let count = bytes.len() / width;
    (0..count * width).map(|i| bytes[i % width * count + i / width]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn filter(id: u16) -> Filter {
        Filter { id, flags: 0, cd_values: Vec::new() }
    }

    #[test]
    fn what_netcdf_packs_is_unpacked() {
        let numbers: Vec<f64> = (0..60).map(|i| f64::from(i) / 7.0).collect();
        let plain: Vec<u8> = numbers.iter().flat_map(|x| x.to_le_bytes()).collect();
        let shuffled: Vec<u8> = (0..8).flat_map(|b| plain.iter().skip(b).step_by(8).copied()).collect();
        let deflated = miniz_oxide::deflate::compress_to_vec_zlib(&shuffled, 5);
        let filters = [filter(SHUFFLE), filter(DEFLATE)];
        assert_eq!(unpacked(deflated.clone(), &filters, 0, 8, 480).as_ref(), Ok(&plain));
        // A chunk that deflate did not make smaller is left as it is.
        assert_eq!(unpacked(shuffled, &filters, 0b10, 8, 480).as_ref(), Ok(&plain));
        assert!(unpacked(deflated.clone(), &filters, 0, 8, 400).is_err_and(|e| e.contains("damaged")));
        assert!(unpacked(deflated[..20].to_vec(), &filters, 0, 8, 480).is_err_and(|e| e.contains("damaged")));
    }

    #[test]
    fn blocks_are_cut_out_of_chunks() {
        let (shape, chunk) = ([5, 7], [2, 3]);
        let number = |row: usize, column: usize| (row * 10 + column) as f64;
        for start in (0..35).map(|i| place(i, &shape)) {
            for end in (0..35).map(|i| place(i, &shape)).filter(|end| end[0] >= start[0] && end[1] >= start[1]) {
                let counts: Vec<usize> = end.iter().zip(&start).map(|(end, start)| end - start + 1).collect();
                let mut block = vec![f64::NAN; counts[0] * counts[1]];
                for corner in (0..9).map(|i| place(i, &[3, 3])).map(|at| [at[0] * chunk[0], at[1] * chunk[1]]) {
                    let cells = (0..6).map(|i| place(i, &chunk));
                    let numbers = cells.map(|c| number(corner[0] + c[0], corner[1] + c[1]));
                    let bytes: Vec<u8> = numbers.flat_map(f64::to_le_bytes).collect();
                    copy_overlap(&bytes, &chunk, &corner, &mut block, &counts, &start);
                }
                let cells = (0..block.len()).map(|i| place(i, &counts));
                let expected: Vec<f64> = cells.map(|c| number(start[0] + c[0], start[1] + c[1])).collect();
                assert_eq!(block, expected, "{start:?} to {end:?}");
            }
        }
    }

    #[test]
    fn numbers_that_no_file_of_its_size_has_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("hollow.h5");
        let file = H5File::create(&path).expect("a file");
        drop(file.new_dataset::<f64>().shape([1 << 28]).chunk(&[1 << 20]).create("hollow").expect("a dataset"));
        file.close().expect("closed");
        let read = Hdf5File::open(&path).and_then(|file| file.variable("hollow"));
        assert!(read.as_ref().is_err_and(|e| e.contains("more than a file of")), "{read:?}");
    }

    #[test]
    fn places_count_row_by_row() {
        assert_eq!((0..6).map(|n| place(n, &[2, 3])).collect::<Vec<_>>()[3..5], [vec![1, 0], vec![1, 1]]);
    }
}
