//! A file system in memory, mounted by FUSE, that forgets at a power cut what was not synced.
//!
//! What POSIX leaves open is drawn by lot at each cut, sector by sector: of a file's bytes that were written since its
//! last sync some are there, some are as before, some are zeros, and its length is anything in between; of a folder's
//! entries since its last sync all are there or none. Only what was synced is certain, a file's content by its own sync
//! and its name by its folder's. A disk that lies about syncs is not simulated: nothing can be kept on one.

use std::collections::BTreeMap;
use std::ffi::{OsStr, OsString};
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime};

use fuser::{
    BackgroundSession, FileAttr, FileType, Filesystem, MountOption, ReplyAttr, ReplyCreate, ReplyData, ReplyDirectory,
    ReplyEmpty, ReplyEntry, ReplyStatfs, ReplyWrite, Request, TimeOrNow,
};
use rand::Rng as _;
use rand_chacha::ChaCha8Rng;
use rustix::io::Errno;

/// Unit that is written as a whole or not at all, in bytes.
const SECTOR: usize = 512;
/// Nothing is cached: the kernel asks each time.
const NO_TIME: Duration = Duration::ZERO;
const ROOT: u64 = 1;

/// The disk; clones share it.
#[derive(Clone)]
pub(crate) struct ForgetfulDisk(Arc<Mutex<FileTree>>);

/// A disk in use. Dropped, it is unmounted.
pub(crate) struct DiskMount {
    _session: BackgroundSession,
}

struct FileTree {
    nodes: BTreeMap<u64, DiskNode>,
    next: u64,
}

#[derive(Clone)]
enum DiskNode {
    File { now: Vec<u8>, safe: Vec<u8> },
    Folder { now: FolderEntries, safe: FolderEntries },
}

type FolderEntries = BTreeMap<OsString, u64>;

impl ForgetfulDisk {
    pub fn new() -> Self {
        let root = DiskNode::Folder { now: FolderEntries::new(), safe: FolderEntries::new() };
        Self(Arc::new(Mutex::new(FileTree { nodes: BTreeMap::from([(ROOT, root)]), next: ROOT + 1 })))
    }

    /// Mounts the disk; nothing if this machine does not allow it.
    pub fn mount(&self, at: &Path) -> Option<DiskMount> {
        let options = [MountOption::FSName("forgetful".into())];
        match fuser::spawn_mount2(DiskFileSystem(self.0.clone()), at, &options) {
            Ok(session) => Some(DiskMount { _session: session }),
            Err(error) => {
                eprintln!("skipped: no file system can be mounted here: {error}");
                None
            }
        }
    }

    /// Cuts the power. The disk must not be mounted.
    pub fn cut(&self, random: &mut ChaCha8Rng) {
        let mut tree = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        for node in tree.nodes.values_mut() {
            match node {
                DiskNode::Folder { now, safe } => {
                    if random.random_bool(0.5) {
                        now.clone_from(safe);
                    }
                    safe.clone_from(now);
                }
                DiskNode::File { now, safe } => {
                    *now = torn(now, safe, random);
                    safe.clone_from(now);
                }
            }
        }
    }
}

// What is left of a file.
fn torn(now: &[u8], safe: &[u8], random: &mut ChaCha8Rng) -> Vec<u8> {
    let length = match now.len().cmp(&safe.len()) {
        std::cmp::Ordering::Equal => now.len(),
        _ => random.random_range(now.len().min(safe.len())..=now.len().max(safe.len())),
    };
    let mut left = Vec::with_capacity(length);
    while left.len() < length {
        let range = left.len()..(left.len() + SECTOR).min(length);
        // Zeros if neither reaches so far; of a sector that was synced and not written since, both are the same.
        let sector = |of: &[u8]| -> Vec<u8> { range.clone().map(|i| of.get(i).copied().unwrap_or(0)).collect() };
        left.extend(if random.random_bool(0.5) { sector(now) } else { sector(safe) });
    }
    left
}

impl FileTree {
    fn folder(&mut self, ino: u64) -> Result<&mut FolderEntries, Errno> {
        match self.nodes.get_mut(&ino) {
            Some(DiskNode::Folder { now, .. }) => Ok(now),
            Some(DiskNode::File { .. }) => Err(Errno::NOTDIR),
            None => Err(Errno::NOENT),
        }
    }

    fn file(&mut self, ino: u64) -> Result<&mut Vec<u8>, Errno> {
        match self.nodes.get_mut(&ino) {
            Some(DiskNode::File { now, .. }) => Ok(now),
            Some(DiskNode::Folder { .. }) => Err(Errno::ISDIR),
            None => Err(Errno::NOENT),
        }
    }

    fn child(&mut self, parent: u64, name: &OsStr) -> Result<u64, Errno> {
        self.folder(parent)?.get(name).copied().ok_or(Errno::NOENT)
    }

    fn add(&mut self, parent: u64, name: &OsStr, node: DiskNode) -> Result<FileAttr, Errno> {
        if self.child(parent, name).is_ok() {
            return Err(Errno::EXIST);
        }
        let ino = self.next;
        self.folder(parent)?.insert(name.to_owned(), ino);
        self.next += 1;
        self.nodes.insert(ino, node);
        self.attributes(ino)
    }

    // Whatever is removed stays in memory: a cut may bring its name back.
    fn remove(&mut self, parent: u64, name: &OsStr) -> Result<(), Errno> {
        self.folder(parent)?.remove(name).map(drop).ok_or(Errno::NOENT)
    }

    fn sync(&mut self, ino: u64) -> Result<(), Errno> {
        match self.nodes.get_mut(&ino).ok_or(Errno::NOENT)? {
            DiskNode::File { now, safe } => safe.clone_from(now),
            DiskNode::Folder { now, safe } => safe.clone_from(now),
        }
        Ok(())
    }

    fn attributes(&self, ino: u64) -> Result<FileAttr, Errno> {
        let (kind, size, perm) = match self.nodes.get(&ino).ok_or(Errno::NOENT)? {
            DiskNode::File { now, .. } => (FileType::RegularFile, now.len() as u64, 0o644),
            DiskNode::Folder { .. } => (FileType::Directory, 0, 0o755),
        };
        let time = SystemTime::UNIX_EPOCH;
        Ok(FileAttr {
            ino,
            size,
            blocks: size.div_ceil(SECTOR as u64),
            atime: time,
            mtime: time,
            ctime: time,
            crtime: time,
            kind,
            perm,
            nlink: 1,
            uid: 0,
            gid: 0,
            rdev: 0,
            blksize: 4096,
            flags: 0,
        })
    }
}

struct DiskFileSystem(Arc<Mutex<FileTree>>);

impl DiskFileSystem {
    fn tree(&self) -> MutexGuard<'_, FileTree> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn entry(reply: ReplyEntry, found: Result<FileAttr, Errno>) {
    match found {
        Ok(attributes) => reply.entry(&NO_TIME, &attributes, 0),
        Err(error) => reply.error(error.raw_os_error()),
    }
}

fn empty(reply: ReplyEmpty, done: Result<(), Errno>) {
    match done {
        Ok(()) => reply.ok(),
        Err(error) => reply.error(error.raw_os_error()),
    }
}

fn attributes(reply: ReplyAttr, found: Result<FileAttr, Errno>) {
    match found {
        Ok(attributes) => reply.attr(&NO_TIME, &attributes),
        Err(error) => reply.error(error.raw_os_error()),
    }
}

impl Filesystem for DiskFileSystem {
    fn lookup(&mut self, _: &Request<'_>, parent: u64, name: &OsStr, reply: ReplyEntry) {
        let mut tree = self.tree();
        let found = tree.child(parent, name).and_then(|ino| tree.attributes(ino));
        entry(reply, found);
    }

    fn getattr(&mut self, _: &Request<'_>, ino: u64, _: Option<u64>, reply: ReplyAttr) {
        attributes(reply, self.tree().attributes(ino));
    }

    fn setattr(
        &mut self,
        _: &Request<'_>,
        ino: u64,
        _mode: Option<u32>,
        _uid: Option<u32>,
        _gid: Option<u32>,
        size: Option<u64>,
        _atime: Option<TimeOrNow>,
        _mtime: Option<TimeOrNow>,
        _ctime: Option<SystemTime>,
        _fh: Option<u64>,
        _crtime: Option<SystemTime>,
        _chgtime: Option<SystemTime>,
        _bkuptime: Option<SystemTime>,
        _flags: Option<u32>,
        reply: ReplyAttr,
    ) {
        let mut tree = self.tree();
        let resized = match size {
            Some(size) => tree.file(ino).map(|file| file.resize(size as usize, 0)),
            None => Ok(()),
        };
        let found = resized.and_then(|()| tree.attributes(ino));
        attributes(reply, found);
    }

    fn mkdir(&mut self, _: &Request<'_>, parent: u64, name: &OsStr, _: u32, _: u32, reply: ReplyEntry) {
        let node = DiskNode::Folder { now: FolderEntries::new(), safe: FolderEntries::new() };
        entry(reply, self.tree().add(parent, name, node));
    }

    fn unlink(&mut self, _: &Request<'_>, parent: u64, name: &OsStr, reply: ReplyEmpty) {
        empty(reply, self.tree().remove(parent, name));
    }

    fn rmdir(&mut self, _: &Request<'_>, parent: u64, name: &OsStr, reply: ReplyEmpty) {
        let mut tree = self.tree();
        let is_empty = tree.child(parent, name).and_then(|ino| tree.folder(ino).map(|f| f.is_empty()));
        let removed = match is_empty {
            Ok(true) => tree.remove(parent, name),
            Ok(false) => Err(Errno::NOTEMPTY),
            Err(error) => Err(error),
        };
        empty(reply, removed);
    }

    fn rename(
        &mut self,
        _: &Request<'_>,
        parent: u64,
        name: &OsStr,
        to: u64,
        new_name: &OsStr,
        _: u32,
        reply: ReplyEmpty,
    ) {
        let mut tree = self.tree();
        let renamed = tree.child(parent, name).and_then(|ino| {
            tree.folder(to)?.insert(new_name.to_owned(), ino);
            if (parent, name) != (to, new_name) { tree.remove(parent, name) } else { Ok(()) }
        });
        empty(reply, renamed);
    }

    fn link(&mut self, _: &Request<'_>, ino: u64, parent: u64, name: &OsStr, reply: ReplyEntry) {
        let mut tree = self.tree();
        let linked = match tree.child(parent, name) {
            Ok(_) => Err(Errno::EXIST),
            Err(_) => tree.folder(parent).map(|folder| {
                folder.insert(name.to_owned(), ino);
            }),
        };
        let found = linked.and_then(|()| tree.attributes(ino));
        entry(reply, found);
    }

    fn create(&mut self, _: &Request<'_>, parent: u64, name: &OsStr, _: u32, _: u32, _: i32, reply: ReplyCreate) {
        match self.tree().add(parent, name, DiskNode::File { now: Vec::new(), safe: Vec::new() }) {
            Ok(made) => reply.created(&NO_TIME, &made, 0, 0, 0),
            Err(error) => reply.error(error.raw_os_error()),
        }
    }

    fn read(
        &mut self,
        _: &Request<'_>,
        ino: u64,
        _: u64,
        offset: i64,
        size: u32,
        _: i32,
        _: Option<u64>,
        reply: ReplyData,
    ) {
        match self.tree().file(ino) {
            Ok(file) => {
                let from = (offset as usize).min(file.len());
                reply.data(&file[from..(from + size as usize).min(file.len())]);
            }
            Err(error) => reply.error(error.raw_os_error()),
        }
    }

    fn write(
        &mut self,
        _: &Request<'_>,
        ino: u64,
        _: u64,
        offset: i64,
        data: &[u8],
        _: u32,
        _: i32,
        _: Option<u64>,
        reply: ReplyWrite,
    ) {
        match self.tree().file(ino) {
            Ok(file) => {
                let (from, to) = (offset as usize, offset as usize + data.len());
                file.resize(file.len().max(to), 0);
                file[from..to].copy_from_slice(data);
                reply.written(data.len() as u32);
            }
            Err(error) => reply.error(error.raw_os_error()),
        }
    }

    // Called at every close, which promises nothing.
    fn flush(&mut self, _: &Request<'_>, _: u64, _: u64, _: u64, reply: ReplyEmpty) {
        reply.ok();
    }

    fn fsync(&mut self, _: &Request<'_>, ino: u64, _: u64, _: bool, reply: ReplyEmpty) {
        empty(reply, self.tree().sync(ino));
    }

    fn fsyncdir(&mut self, _: &Request<'_>, ino: u64, _: u64, _: bool, reply: ReplyEmpty) {
        empty(reply, self.tree().sync(ino));
    }

    fn readdir(&mut self, _: &Request<'_>, ino: u64, _: u64, offset: i64, mut reply: ReplyDirectory) {
        let mut tree = self.tree();
        let entries: Vec<_> = match tree.folder(ino) {
            Ok(entries) => entries.iter().map(|(name, ino)| (name.clone(), *ino)).collect(),
            Err(error) => return reply.error(error.raw_os_error()),
        };
        for (index, (name, child)) in entries.iter().enumerate().skip(offset as usize) {
            let kind = tree.attributes(*child).map_or(FileType::RegularFile, |a| a.kind);
            if reply.add(*child, index as i64 + 1, kind, name) {
                break;
            }
        }
        reply.ok();
    }

    fn statfs(&mut self, _: &Request<'_>, _: u64, reply: ReplyStatfs) {
        // 4 GiB, all free.
        reply.statfs(1 << 20, 1 << 20, 1 << 20, 1 << 20, 1 << 20, 4096, 255, 4096);
    }
}
