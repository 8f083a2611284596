from .pictures import FastcamMrawSource as FastcamMrawSource
from .pictures import ImageFolderSource as ImageFolderSource
from .pictures import open_recording as open_recording
from .video import VideoSource as VideoSource
