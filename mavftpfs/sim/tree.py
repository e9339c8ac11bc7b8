"""The trees a simulated server can serve. Layer: sim."""

from mavftpfs.sim.directorytree import DirectoryTree
from mavftpfs.sim.filesystem import Entry, Kind, Stat, Tree, TreeFile
from mavftpfs.sim.memorytree import MemoryTree

__all__ = ["DirectoryTree", "Entry", "Kind", "MemoryTree", "Stat", "Tree", "TreeFile"]
