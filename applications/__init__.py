"""What cells are for: one folder is one application. See common/application.py for what lies in one."""
