from .mraw import FastcamMrawSource as FastcamMrawSource
from .mraw import open_recording as open_recording
from .pictures import ImageFolderSource as ImageFolderSource
from .video import VideoSource as VideoSource
