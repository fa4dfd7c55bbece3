"""Reading of untrusted files (`reading`), and paths and writing of all outputs.

No other module opens a file for writing, as checked by `tests/files/test_one_reader_and_writer.py`.
"""

from .paths import OutputPath as OutputPath
from .paths import allowed_names as allowed_names
from .paths import check_name as check_name
from .paths import file_name as file_name
from .paths import name_fault as name_fault
from .paths import open_below as open_below
from .paths import opened_folder as opened_folder
from .paths import output_path as output_path
from .paths import resolved_paths as resolved_paths
from .paths import unique_file_names as unique_file_names
from .writing import MARKER as MARKER
from .writing import BusyError as BusyError
from .writing import append_line as append_line
from .writing import csv_cell as csv_cell
from .writing import holds_file as holds_file
from .writing import indented_json as indented_json
from .writing import locked_folder as locked_folder
from .writing import output_stream as output_stream
from .writing import pipe_stream as pipe_stream
from .writing import published as published
from .writing import published_file as published_file
from .writing import remove_file as remove_file
from .writing import set_aside as set_aside
from .writing import synchronize as synchronize
from .writing import text_of_cell as text_of_cell
from .writing import try_lock as try_lock
from .writing import write_bytes as write_bytes
from .writing import write_link as write_link
from .writing import write_new as write_new
from .writing import write_text as write_text
